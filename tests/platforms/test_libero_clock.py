"""The clock of LIBERO's observations."""

from __future__ import annotations

import numpy as np
import pytest

from lerobot_roborecover.platforms.libero.assets import (
    find_assets,
    quiet_import,
)

pytestmark = pytest.mark.libero


def test_observable_clock_is_robosuites():
    quiet_import(find_assets())
    from robosuite.utils.observables import Observable, sensor

    from lerobot_roborecover.platforms.libero.view import ObservableClock

    calls = []

    @sensor(modality="test")
    def count(_cache):
        calls.append(0)
        return np.zeros(3)

    observable = Observable("count", count, sampling_rate=20)
    for _ in range(2):
        observable.update(0.002, {}, force=True)
    clock = ObservableClock(0.002, 1 / 20)
    for _ in range(3000):  # control steps
        samples = 0
        for _ in range(25):
            calls.clear()
            observable.update(0.002, {})
            ticked = clock.tick()
            assert ticked == bool(calls)
            samples += ticked
        assert samples == 1  # so that one step after a restore makes its observation valid
    assert clock.state[0] == observable._time_since_last_sample
