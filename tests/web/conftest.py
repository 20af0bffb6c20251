"""Fixtures that tests of teleoperation share."""

import pytest

from tests.support.teleop_sessions import cockpit


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    with cockpit(tmp_path_factory.mktemp("r") / "set.recordings") as found:
        yield found
