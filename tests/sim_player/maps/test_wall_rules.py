"""Materials and heights by the tags of a map."""

from __future__ import annotations

from pathlib import Path

import pytest

from models.physics.materials import typical_roughness_mm, wall_layers
from sim_player.maps.wall_rules import DEFAULT_RULES, WallRule, height_of, read_rules, rule_of


@pytest.mark.parametrize(
    ("tags", "material"),
    [
        ({}, "concrete"),
        ({"building": "yes"}, "concrete"),
        ({"building": "House"}, "brick"),
        ({"building": "house", "building:material": "wood"}, "wood"),
        ({"building": "house", "building:material": "straw"}, "brick"),
        ({"building": "garages"}, "metal"),
    ],
)
def test_what_the_walls_are_said_to_be_goes_before_the_kind(tags: dict[str, str], material: str) -> None:
    assert rule_of(tags, DEFAULT_RULES).material == material


def test_every_rule_names_a_wall_that_the_radar_knows() -> None:
    for rule in DEFAULT_RULES:
        assert wall_layers(rule.material, None, 10e9)
        usual = typical_roughness_mm(rule.material)
        assert usual is None or 0.0 < rule.roughness_mm <= usual[1] * 2.0


def test_given_rules_go_first(tmp_path: Path) -> None:
    path = tmp_path / "rules.yaml"
    path.write_text("- {key: building, value: house, material: wood, thickness_mm: 20}\n")
    rules = read_rules(["building:material=brick:glass,6,0.02", "*=*:double_glazing", str(path)])
    assert rule_of({"building:material": "brick"}, rules) == WallRule(
        key="building:material", value="brick", material="glass", thickness_mm=6.0, roughness_mm=0.02
    )
    assert rule_of({"building": "house"}, rules).material == "double_glazing"
    assert rule_of({"building": "house"}, read_rules([str(path)])).thickness_mm == 20.0


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("", "--materials must be KEY=VALUE:MATERIAL"),
        ("building=house", "--materials must be KEY=VALUE:MATERIAL"),
        ("building=house:cheese", "unknown material 'cheese'"),
        ("building=house:brick,x", "could not convert"),
        ("building=house:brick,-1", "thickness_mm must be"),
        ("building=house:brick,nan", "thickness_mm must be"),
        ("building=house:double_glazing,20", "has the thicknesses of its layers"),
    ],
)
def test_a_rule_that_is_none_is_named(text: str, line: str) -> None:
    with pytest.raises(ValueError, match=line):
        read_rules([text])


@pytest.mark.parametrize(
    "content", ["3", "- 3", "- {key: a}", "- {key: a, material: brick, x: 1}", "a: [", "- !!int x"]
)
def test_a_file_that_holds_no_rules_is_named(tmp_path: Path, content: str) -> None:
    path = tmp_path / "rules.yaml"
    path.write_text(content)
    with pytest.raises(ValueError, match=r"rules\.yaml: "):
        read_rules([str(path)])


@pytest.mark.parametrize(
    ("tags", "height_m"),
    [
        ({"height": "7"}, 7.0),
        ({"height": "7,5 m"}, 7.5),
        ({"height": "20'"}, 6.096),
        ({"building:levels": "4"}, 12.0),
        ({"height": "tall", "building:levels": "2"}, 6.0),
        ({"height": "0"}, None),
        ({"height": "1e5"}, None),
        ({}, None),
    ],
)
def test_heights_in_metres_feet_and_storeys(tags: dict[str, str], height_m: float | None) -> None:
    assert height_of(tags) == (None if height_m is None else pytest.approx(height_m))
