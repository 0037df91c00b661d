"""Fixtures for the tests of all rooms."""

import sys

import pytest

from tests.trainer_port.ros_master import running_master


@pytest.fixture(scope="session")
def ros_master(tmp_path_factory):
    """The address of a real roscore; one for all, because a process can be a ROS node only once."""
    with running_master(tmp_path_factory.mktemp("ros")) as uri:
        yield uri
        if "rospy" in sys.modules:  # sign off while the master can still hear it
            sys.modules["rospy"].signal_shutdown("the tests are over")
