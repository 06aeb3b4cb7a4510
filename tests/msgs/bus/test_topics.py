"""The table of topics: what its bounds promise."""

from __future__ import annotations

import pytest

from msgs.bus.topics import TOPICS, Topic
from msgs.values.radar import RadarSetup


@pytest.mark.parametrize("topic", TOPICS.values(), ids=list(TOPICS))
def test_a_full_queue_stays_within_the_history_and_holds_all_that_fits(topic: Topic) -> None:
    """As many of the largest messages as `history_bytes` takes, not one more."""
    full_bytes = topic.history_messages * topic.max_bytes
    assert full_bytes <= topic.history_bytes < full_bytes + topic.max_bytes


def test_a_queue_of_beams_outlasts_a_pause_of_one_scan() -> None:
    """A receiver that pauses for a scan of 0.3 s loses no beam."""
    beam = TOPICS["radar/beam"]
    assert beam.history_messages >= len(RadarSetup().beams)
    assert beam.history_messages >= round(0.3 * beam.rate_hz)


def test_a_queue_takes_a_message_larger_than_its_history() -> None:
    topic = Topic(name="x", type=RadarSetup, rate_hz=1.0, max_bytes=8, history_bytes=4)
    assert topic.history_messages == 1


def test_what_comes_once_a_scan_comes_at_the_radars_rate() -> None:
    """Maps, peaks, views and truth: one scan per 0.3 s, and so many beams in it."""
    setup = RadarSetup()
    scans_hz = 1.0 / setup.radar.scan_period_s
    for name in ("radar/ra_map", "lidar/histograms", "perception/peaks", "perception/hidden_objects", "sim/truth"):
        assert TOPICS[name].rate_hz == pytest.approx(scans_hz), name
    assert TOPICS["radar/beam"].rate_hz == pytest.approx(len(setup.beams) * scans_hz)
