"""Fixtures of the tests that run the firmware in the simulated chip."""

import pytest

from falconwing_kit.tools.bridge.simulated_board import SimulatedBoard
from tests.firmware.chip import Bench, require_tools


@pytest.fixture
def bench():
    """The shipped firmware, switched on 0.1 s ago."""
    require_tools()
    with SimulatedBoard() as board:
        yield Bench(board)
