"""Walls of buildings by rule, the first that its tags meet: what they are made of and how high they are.

Walls have no back unless a rule says how thick they are: maps know nothing of what stands inside a house.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path

import msgspec
import yaml

from models.physics.materials import CONSTRUCTIONS, wall_name
from msgs.files.text_files import decode_text
from msgs.files.yaml_loader import BoundedLoader, in_words

#: Rules in one file.
MAX_RULES, MAX_RULE_BYTES = 500, 1 << 16
#: Height of a storey, and of a building of which the map says nothing.
STOREY_M, DEFAULT_HEIGHT_M = 3.0, 6.0
#: Heights beyond are mistakes of the map.
HEIGHTS_M = (1.0, 900.0)
FOOT_M = 0.3048
ANY = "*"
_HEIGHT = re.compile(r"\s*(\d+(?:[.,]\d+)?)\s*(m|metres|meters|ft|')?\s*")


class WallRule(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Walls of the buildings that have a tag of this value ("*": any value, or none for the key "*")."""

    key: str
    value: str = ANY
    material: str
    thickness_mm: float | None = None
    roughness_mm: float = 0.0

    def __post_init__(self) -> None:
        name = wall_name(self.material)
        for field, low in (("thickness_mm", 1e-3), ("roughness_mm", 0.0)):
            value = getattr(self, field)
            if value is not None and not low <= value <= 1e4:
                raise ValueError(f"{field} must be {low:g}..10000 mm, got {value!r}")
        if self.thickness_mm is not None and name in CONSTRUCTIONS:
            raise ValueError(f"{name} has the thicknesses of its layers: give none, got {self.thickness_mm!r}")

    def holds(self, tags: Mapping[str, str]) -> bool:
        """Return whether a building has the rule's tag."""
        if self.key == ANY:
            return True
        return self.key in tags and self.value in (ANY, tags[self.key].strip().lower())


def _rules(key: str, table: dict[str, tuple[str, float]]) -> tuple[WallRule, ...]:
    return tuple(
        WallRule(key=key, value=value, material=material, roughness_mm=roughness_mm)
        for values, (material, roughness_mm) in table.items()
        for value in values.split()
    )


#: By what the map says of the walls, else by the kind of building, else concrete. Roughness: the middle of
#: `models.physics.materials.TYPICAL_ROUGHNESS_MM`, that of stone as of brick.
DEFAULT_RULES: tuple[WallRule, ...] = (
    *_rules(
        "building:material",
        {
            "brick bricks clinker": ("brick", 1.0),
            "concrete reinforced_concrete cement cement_block plaster": ("concrete", 0.3),
            "glass mirror": ("glass", 0.03),
            "metal metal_plates steel tin aluminium": ("metal", 0.03),
            "wood timber timber_framing": ("wood", 0.5),
            "stone sandstone limestone granite": ("concrete", 1.0),
            "marble": ("marble", 0.3),
        },
    ),
    *_rules(
        "building",
        {
            "house detached semidetached_house terrace residential apartments bungalow school church": ("brick", 1.0),
            "industrial warehouse hangar garage garages container silo storage_tank": ("metal", 0.03),
            "greenhouse": ("glass", 0.03),
            "cabin shed hut barn farm_auxiliary": ("wood", 0.5),
        },
    ),
    WallRule(key=ANY, material="concrete", roughness_mm=0.3),
)


def rule_of(tags: Mapping[str, str], rules: tuple[WallRule, ...]) -> WallRule:
    """Return the first rule that a building's tags meet."""
    return next(rule for rule in rules if rule.holds(tags))


def read_rules(texts: list[str]) -> tuple[WallRule, ...]:
    """Return rules given as KEY=VALUE:MATERIAL[,THICKNESS_MM[,ROUGHNESS_MM]] or YAML files, then the default ones."""
    given: list[WallRule] = []
    for text in texts:
        given += _rule_file(Path(text)) if text.lower().endswith((".yaml", ".yml")) else [_rule(text)]
    return (*given, *DEFAULT_RULES)


def _rule(text: str) -> WallRule:
    """Return the rule of one text; the key may hold colons (`building:material=brick:concrete`)."""
    key, equals, rest = text.partition("=")
    value, colon, walls = rest.partition(":")
    material, *numbers = walls.split(",")
    if not (key and equals and value and colon and material and len(numbers) <= 2):
        raise ValueError(
            f"--materials must be KEY=VALUE:MATERIAL[,THICKNESS_MM[,ROUGHNESS_MM]] or a .yaml file, got {text!r}"
        )
    try:
        thickness, roughness = (float(number) if number else None for number in (*numbers, "", "")[:2])
        return WallRule(
            key=key, value=value.lower(), material=material, thickness_mm=thickness, roughness_mm=roughness or 0.0
        )
    except ValueError as error:
        raise ValueError(f"--materials {text!r}: {error}") from None


def _rule_file(path: Path) -> list[WallRule]:
    """Return the rules of a YAML file: a list of mappings of `WallRule`'s fields."""
    try:
        raw = path.read_bytes()
        if len(raw) > MAX_RULE_BYTES:
            raise ValueError(f"must hold at most {MAX_RULE_BYTES} bytes, got {len(raw)}")
        content = yaml.load(decode_text(raw), Loader=BoundedLoader)
        if not isinstance(content, list) or len(content) > MAX_RULES:
            raise ValueError(f"expected a list of {MAX_RULES} rules at most, got {in_words(content)}")
        return [msgspec.convert(rule, WallRule) for rule in content]
    except yaml.YAMLError as error:
        raise ValueError(f"{path}: not YAML: {' '.join(str(error).split())}") from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def height_of(tags: Mapping[str, str]) -> float | None:
    """Return the height [m] that tags state, by `height` or by storeys; None where they say nothing usable."""
    for key, unit_m in (("height", 1.0), ("building:height", 1.0), ("building:levels", STOREY_M), ("levels", STOREY_M)):
        height_m = length_m(tags.get(key, ""), unit_m)
        if height_m is not None and HEIGHTS_M[0] <= height_m <= HEIGHTS_M[1]:
            return height_m
    return None


def length_m(text: str, unit_m: float = 1.0) -> float | None:
    """Return the length [m] of a tag, in feet or in units of `unit_m`; None where it is none."""
    met = _HEIGHT.fullmatch(text)
    if met is None:
        return None
    value_m = float(met[1].replace(",", ".")) * (FOOT_M if met[2] in ("ft", "'") else unit_m)
    return value_m if math.isfinite(value_m) else None
