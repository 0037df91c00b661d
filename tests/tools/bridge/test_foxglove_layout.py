"""Layout for Foxglove: it names topics and fields that a log of the kit has, and no others."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

import falconwing_kit
from falconwing_kit.core.flight_log import FlightLogWriter
from falconwing_kit.core.messages import Command, Image, State

LAYOUT = Path(falconwing_kit.__file__).parent / "tools" / "bridge" / "foxglove_layout.json"


@pytest.fixture(scope="module")
def layout() -> dict[str, Any]:
    return json.loads(LAYOUT.read_text())


@pytest.fixture(scope="module")
def fields(tmp_path_factory) -> dict[str, set[str]]:
    """The fields of each topic's messages in a short flight behind a leader."""
    path = tmp_path_factory.mktemp("log") / "flight.mcap"
    level = State.from_vector(np.arange(12.0))
    with FlightLogWriter(path) as log:
        log.command(0.0, Command(0.5, 0.0, 0.0, 0.0, 0), Image(0, 0.0, np.zeros(9, np.uint8)))
        log.state(0.0, level, 0)
        log.leader(0.0, level)
        log.event(0.0, "mode", {"mode": "flare"})
    with path.open("rb") as file:
        return {
            channel.topic: set(json.loads(message.data))
            for _, channel, message in make_reader(file).iter_messages()
        }


def panels(tree: Any) -> Iterator[str]:
    """The panels of a layout's tree, from left to right."""
    if isinstance(tree, str):
        yield tree
    else:
        assert tree["direction"] in ("row", "column") and 0 < tree["splitPercentage"] < 100
        yield from panels(tree["first"])
        yield from panels(tree["second"])


def test_every_panel_is_configured_and_shown_once(layout):
    """An image, the hall in 3D, plots and the events."""
    shown = list(panels(layout["layout"]))
    assert sorted(shown) == sorted(layout["configById"]) and len(set(shown)) == len(shown)
    kinds = [name.partition("!")[0] for name in shown]
    assert {"Image", "3D", "Plot", "RosOut"} == set(kinds)


def test_panels_name_topics_that_logs_have(layout, fields):
    """Image, text and every plotted field, by topic and name; frames by their names."""
    config = layout["configById"]
    topics = [p["imageMode"]["imageTopic"] for n, p in config.items() if n.startswith("Image")]
    topics += [p["topicToRender"] for n, p in config.items() if n.startswith("RosOut")]
    topics += list(config["3D!hall"]["topics"])
    assert set(topics) <= fields.keys() and len(topics) == 3
    plotted = [
        path["value"].split(".")
        for name, panel in config.items()
        if name.startswith("Plot")
        for path in panel["paths"]
    ]
    assert {"height_m", "speed_m_s", "throttle", "elevator"} <= {field for _, field in plotted}
    for topic, field in plotted:
        assert field in fields[topic]
    frames = {name.removeprefix("frame:") for name in config["3D!hall"]["transforms"]}
    assert frames == {"world", *(t.removeprefix("/frame/") for t in fields if "/frame/" in t)}
