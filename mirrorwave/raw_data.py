"""Check that a file holds raw data for the start of the graph; if not, name its content and the verb that takes it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from models.perception.form.coarray import require_formable
from msgs.bus.topics import RAW_TOPICS, SENSOR_TOPICS, plain_topic, sensor_of, sensor_topic
from msgs.recording.mcap import RecordingReader
from msgs.recording.sigmf import SigmfCapture
from msgs.values.radar import RadarSetup
from nodes.player import first_setups


def require_raw(capture: Path) -> None:
    """Raise `ValueError`, saying what a file holds and which verb takes it, unless raw data can be processed."""
    if capture.is_dir():
        raise ValueError(f"{capture}: is a folder, must be a recording NAME.mcap or a SigMF capture NAME.sigmf-meta")
    if capture.suffix != ".mcap":
        is_sigmf = capture.suffix in (".sigmf-meta", ".sigmf-data") or Path(f"{capture}.sigmf-meta").is_file()
        if capture.is_file() and not is_sigmf:
            is_scene = capture.suffix in (".yaml", ".yml")
            scene = "; mirrorwave sim run SCENE --out NAME.mcap records a scene" if is_scene else ""
            raise ValueError(f"{capture}: must be a recording NAME.mcap or a SigMF capture NAME.sigmf-meta{scene}")
        _require_formable(capture, SigmfCapture.open(capture, verify=False).setup)
        return
    with RecordingReader(capture) as reader:
        held = reader.types
        loss = f" ({reader.loss})" if reader.loss else ""
        setups = [(item.topic, item.message) for item in first_setups(reader).values()]
    for raw in held:
        for setup, measured in SENSOR_TOPICS:
            setup = sensor_topic(setup, sensor_of(raw))
            if plain_topic(raw) == measured and setup not in held:
                raise ValueError(f"{capture}: holds no {setup}, which says how to read its {raw}")
    if not any(plain_topic(raw) in RAW_TOPICS for raw in held):
        content = "holds no radar/beam, no lidar/histograms and no radar/detections to process"
        raise ValueError(f"{capture}: {content}; {_use_of(capture, held)}{loss}")
    for topic, message in setups:
        if isinstance(message, RadarSetup) and sensor_topic("radar/beam", sensor_of(topic)) in held:
            _require_formable(capture, message)


def sensors_in(capture: Path) -> tuple[str, ...]:
    """Return the names of the sensors whose raw data a capture holds; none where there is one without a name."""
    if capture.suffix != ".mcap" or not capture.is_file():
        return ()
    with RecordingReader(capture) as reader:
        raw = [topic for topic in reader.types if plain_topic(topic) in RAW_TOPICS]
    return tuple(sorted({sensor_of(topic) for topic in raw} - {""}))


def _require_formable(capture: Path, setup: RadarSetup) -> None:
    """Raise `ValueError` for a radar of which no map can be formed."""
    try:
        require_formable(setup)
    except ValueError as error:
        raise ValueError(f"{capture}: its radar: {error}") from None


def _use_of(recording: Path, held: Iterable[str]) -> str:
    """Describe the content of a recording without raw data, and its use."""
    content = ", ".join(sorted(held)) or "nothing"
    use = f": `mirrorwave view {recording}` shows it" if "perception/hidden_objects" in held else ""
    return f"it holds {content}{use}. Raw data are recorded with --raw"
