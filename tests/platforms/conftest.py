"""What tests of platforms share."""

from __future__ import annotations

import pytest

from lerobot_roborecover.platforms.libero.assets import ASSETS_VARIABLE
from lerobot_roborecover.platforms.simulator import SimulatorError


@pytest.fixture(scope="module")
def simulator():
    """LIBERO's, without pictures; modules of other platforms have their own."""
    from lerobot_roborecover.platforms.libero.simulator import LiberoSimulator

    try:
        made = LiberoSimulator(obs_type="state")
    except SimulatorError:
        pytest.skip(f"no LIBERO assets; set {ASSETS_VARIABLE}")
    yield made
    made.close()
