"""Fixtures of the tests that run the firmware in the simulated chip."""

import pytest

from tests.firmware.chip import Bench, ProbedBoard, require_tools


@pytest.fixture
def bench():
    """The shipped firmware, switched on 0.1 s ago."""
    require_tools()
    with ProbedBoard() as board:
        yield Bench(board)
