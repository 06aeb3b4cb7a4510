"""Topics of sensors with names: `radar/left/beam` has the facts of `radar/beam`."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from msgs.bus.declared import expect_declared, write_declared
from msgs.bus.local import LocalNetwork
from msgs.bus.topics import TOPICS, plain_topic, sensor_of, sensor_topic, topic_facts
from msgs.values.radar import RadarSetup


@pytest.mark.parametrize(
    ("topic", "named"),
    [
        ("radar/beam", "radar/left/beam"),
        ("lidar/setup", "lidar/left/setup"),
        ("perception/hidden_objects", "perception/left/hidden_objects"),
        ("vehicle/state", "vehicle/state"),
        ("sim/truth", "sim/truth"),
        ("environment/walls", "environment/walls"),
    ],
)
def test_names_come_and_go(topic: str, named: str) -> None:
    """What is the vehicle's has no sensor."""
    assert sensor_topic(topic, "left") == named
    assert plain_topic(named) == topic
    assert sensor_of(named) == ("" if named == topic else "left")
    assert sensor_topic(topic, "") == topic


def test_facts_are_those_of_the_plain_topic() -> None:
    """Type, rate, limits and history."""
    own, plain = topic_facts("radar/left/beam"), topic_facts("radar/beam")
    assert own == msgspec.structs.replace(plain, name="radar/left/beam")
    assert TOPICS.origin("radar/left/beam") == "mirrorwave"
    assert "radar/left/beam" not in TOPICS.own()


@pytest.mark.parametrize(
    "topic", ["radar/Left/beam", "radar/left/nothing", "radar/l/e/beam", "vehicle/left/state", "radar//beam"]
)
def test_others_are_not_known(topic: str) -> None:
    """No sensor, no topic of a sensor."""
    assert topic not in TOPICS
    assert sensor_of(topic) in ("", "Left")
    with pytest.raises(ValueError, match="unknown topic"):
        topic_facts(topic)


@pytest.mark.parametrize("sensor", ["Left", "1", "a/b", "", "l" * 21, "."])
def test_bad_names_are_refused(sensor: str) -> None:
    """One line with the rule."""
    if sensor:
        with pytest.raises(ValueError, match="a sensor's name must be"):
            sensor_topic("radar/beam", sensor)


def test_two_radars_do_not_hear_each_other() -> None:
    """Each topic is one stream of its own."""
    network = LocalNetwork()
    left, right = (network.bus(name) for name in ("a", "b"))
    left.subscribe("radar/left/setup")
    right.subscribe("radar/right/setup")
    network.bus("driver").publish("radar/left/setup", RadarSetup())
    assert [item.topic for item in left.receive(0.0)] == ["radar/left/setup"]
    assert right.receive(0.0) == []


def test_a_graph_says_which_sensors_it_has(tmp_path: Path) -> None:
    """Who opens a bus there lists their topics; a name that is none is passed over."""
    with TOPICS.restored():
        write_declared(tmp_path, {}, "launch file of graph two", ("left", "No"))
        (tmp_path / "topics.json").chmod(0o600)
        expect_declared(tmp_path)
        assert {"radar/left/beam", "perception/left/peaks", "lidar/left/points"} <= set(TOPICS)
        assert not any("/No/" in topic for topic in TOPICS)
