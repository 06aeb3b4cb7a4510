"""Recordings made of recordings: thinned ones and several in one (recovery and spans: `test_mcap.py`)."""

from __future__ import annotations

from pathlib import Path

import pytest

from msgs.recording.mcap import METADATA_NAME, RecordingReader, RecordingWriter, info
from msgs.recording.mcap_copy import Copied, copy_recording, merge_recordings
from msgs.values.radar import RadarSetup
from tests.msgs.recording.test_mcap import METADATA, foreign, keys, read, record, state


def test_every_third_message_of_each_publisher_is_kept_and_latched_topics_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, METADATA) as writer:
        for index in range(7):
            for car in ("one", "two"):
                writer.write("vehicle/state", state(index), publisher=car, sequence=index, sent_ns=10 * index)
            writer.write(
                "radar/setup", RadarSetup(stamp_ns=index), publisher="radar", sequence=index, sent_ns=10 * index
            )
    assert copy_recording(path, tmp_path / "b.mcap", every=3) == (3 + 3 + 7, None)
    with RecordingReader(tmp_path / "b.mcap") as reader:
        kept = [(item.publisher, item.sequence) for item in reader.messages(["vehicle/state"])]
    assert kept == [(car, index) for index in (0, 3, 6) for car in ("one", "two")]
    with pytest.raises(ValueError, match="every must be finite and positive, got 0"):
        copy_recording(path, tmp_path / "c.mcap", every=0)
    assert not (tmp_path / "c.mcap").exists()


def test_merged_recordings_are_in_order_of_time_and_hold_each_message_once(tmp_path: Path) -> None:
    """Two halves that overlap by a third give the whole again, byte for byte; so do three in any order."""
    whole = record(tmp_path / "whole.mcap", count=30)
    copy_recording(whole, tmp_path / "first.mcap", end_ns=200)
    copy_recording(whole, tmp_path / "second.mcap", start_ns=100)
    parts = [tmp_path / "second.mcap", tmp_path / "first.mcap"]
    assert merge_recordings(parts, tmp_path / "merged.mcap") == Copied(60, None, repeated=20)
    assert keys(read(tmp_path / "merged.mcap")[0]) == keys(read(whole)[0])
    assert merge_recordings([*parts, whole], tmp_path / "again.mcap") == Copied(60, None, repeated=80)
    summary = info(tmp_path / "again.mcap")
    assert (summary.complete, summary.checksums_agree, summary.metadata) == (True, True, METADATA)


def test_publishers_and_metadata_of_all_sources_are_kept(tmp_path: Path) -> None:
    """The same numbers of two cars are other messages; a second record of a name carries the name of its file."""
    for car in ("one", "two"):
        with RecordingWriter(tmp_path / f"{car}.mcap", {"scene": car}) as writer:
            writer.write("vehicle/state", state(1), publisher=car, sequence=0, sent_ns=5)
    merged = tmp_path / "merged.mcap"
    sources = [tmp_path / "one.mcap", tmp_path / "two.mcap", foreign(tmp_path / "f.mcap", chunked=True)]
    assert merge_recordings(sources, merged) == Copied(2 + 6, None)
    summary = info(merged)
    assert summary.metadata["scene"] == "one"
    with RecordingReader(merged) as reader:
        assert reader.metadata_records[f"{METADATA_NAME} (two.mcap)"]["scene"] == "two"
    publishers = {topic.topic: topic.publishers for topic in summary.topics}
    assert publishers["vehicle/state"] == ("", "one", "two")


def test_a_damaged_source_is_named_and_gives_what_it_has(tmp_path: Path) -> None:
    whole = record(tmp_path / "whole.mcap", count=5, step_ns=2_000_000_000)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[:-3000])
    other = tmp_path / "other.mcap"
    with RecordingWriter(other, METADATA) as writer:
        writer.write("vehicle/state", state(1), publisher="other", sequence=0, sent_ns=5)
    copied = merge_recordings([cut, other], tmp_path / "merged.mcap")
    assert copied.loss is not None
    assert copied.loss.startswith("cut.mcap: cut off at byte")
    assert copied.messages == len(read(cut)[0]) + 1


def test_what_exists_is_kept_and_what_is_no_recording_leaves_nothing(tmp_path: Path) -> None:
    whole = record(tmp_path / "whole.mcap")
    with pytest.raises(FileExistsError, match=r"other\.mcap: exists already"):
        merge_recordings([whole], record(tmp_path / "other.mcap"))
    (tmp_path / "empty.mcap").write_bytes(b"")
    with pytest.raises(ValueError, match=r"empty\.mcap: is empty"):
        merge_recordings([whole, tmp_path / "empty.mcap"], tmp_path / "merged.mcap")
    assert not (tmp_path / "merged.mcap").exists()
