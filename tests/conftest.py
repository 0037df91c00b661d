"""Fixtures for the tests of all rooms, and the mark of those that need the machine alone."""

import sys

import pytest

from tests.alone import keep_apart, needs_the_machine, place_in_line
from tests.trainer_port.ros_master import running_master

_CACHE = keep_apart()  # before a test loads numba or torch


@pytest.hookimpl(tryfirst=True)  # before -m chooses
def pytest_collection_modifyitems(items):
    """Mark what tests/alone.py names; where several processes share the tests, put the longest
    first.
    """
    for item in items:
        if needs_the_machine(item.path):
            item.add_marker("alone")
    if _CACHE is not None:
        items.sort(key=lambda item: place_in_line(item.path))


@pytest.fixture(autouse=True)
def same_random_numbers():
    """PyTorch's own generator starts anew in each test, whatever ran before it in the process."""
    if "torch" in sys.modules:
        sys.modules["torch"].manual_seed(0)


@pytest.fixture(scope="session")
def ros_master(tmp_path_factory):
    """The address of a real roscore; one for all, because a process can be a ROS node only once."""
    with running_master(tmp_path_factory.mktemp("ros")) as uri:
        yield uri
        if "rospy" in sys.modules:  # sign off while the master can still hear it
            sys.modules["rospy"].signal_shutdown("the tests are over")
