"""The sample capture that ships, launch/samples/side_street.mcap, simulated again.

Scans 4 to 15 of the drive past a side street, with all effects that it calls for. The radar samples as fast as the
range of its map needs, not eight times as fast, and the noise takes less than a bit of its converter: both make the
file small. Beams have 16 chirps of eight times the power instead of 128: the same energy, and the same view.
Usage: python -m benchmarks.simulator.sample_capture [--out launch/samples/side_street.mcap]
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from msgs.bus.interface import Outgoing
from msgs.files.shipped import LAUNCH, SAMPLE
from msgs.files.whole_files import whole
from msgs.recording.mcap import RecordingWriter
from msgs.values.radar import RadarParams, RadarSetup
from nodes.player import scene_events
from sim_player.player import ScenePlayer
from sim_player.scene.description import load_scene

DRIVE = LAUNCH / "drives" / "side_street.yaml"
SEED = 0
#: Before them the cars are far and beams so short count as silent; after them the moving car is in plain sight.
SCANS = range(4, 16)
SAMPLES_PER_CHIRP, CHIRPS_PER_BEAM, FULL_SCALE_DBM = 1024, 16, 10.0


def sample_setup() -> RadarSetup:
    """Return the set-up of the specification with fewer samples of the same chirp."""
    full = RadarParams()
    rate_hz = full.sample_rate_hz * SAMPLES_PER_CHIRP / full.samples_per_chirp
    radar = RadarParams(
        sample_rate_hz=rate_hz,
        samples_per_chirp=SAMPLES_PER_CHIRP,
        chirps_per_beam=CHIRPS_PER_BEAM,
        transmit_power_w=full.transmit_power_w * full.chirps_per_beam / CHIRPS_PER_BEAM,
    )
    return RadarSetup(radar=radar, full_scale_dbm=FULL_SCALE_DBM)


def sample_events() -> Iterator[Outgoing]:
    """Yield set-up, vehicle states, beams and truth of the sample in order."""
    player = ScenePlayer(load_scene(DRIVE), seed=SEED, setup=sample_setup(), effects="auto")
    start_ns = player.stamp_ns(SCANS.start)
    for event in scene_events(player, SCANS.stop):
        message = event.outgoing.message
        if event.outgoing.topic == "radar/setup" or message.stamp_ns >= start_ns:  # type: ignore[attr-defined]
            yield event.outgoing


def write_sample(path: Path) -> None:
    """Write the sample; errors as those of `RecordingWriter`."""
    sequences: dict[str, int] = {}
    metadata = {"scene": "side_street", "seed": str(SEED)}
    with whole(path) as part, RecordingWriter(part, metadata, archive=True) as writer:
        for topic, message in sample_events():
            sequence = sequences.get(topic, 0)
            sequences[topic] = sequence + 1
            sent_ns: int = message.stamp_ns  # type: ignore[attr-defined]
            writer.write(topic, message, publisher="player", sequence=sequence, sent_ns=sent_ns)


def main() -> None:
    """Write the file and say its size."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=SAMPLE)
    out: Path = parser.parse_args().out
    out.parent.mkdir(parents=True, exist_ok=True)
    write_sample(out)
    print(f"{out}: {out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
