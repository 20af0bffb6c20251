"""Which policies are complete, and so are ranked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.analysis.stats.arms import Arm
from lerobot_roborecover.analysis.stats.complete_subset import Compared, compared
from lerobot_roborecover.analysis.stats.panel import Panel


def ranked_subset(panel: Panel, direct: Sequence[Arm], options: Options) -> Compared:
    """Which policies are ranked; none whose run stopped early beside one that did not."""
    run = panel.trials > 0
    early = np.array([arm.unreached for arm in direct])
    if early.any() and not early.all():
        run = run & ~early[:, None]
    lacking = incomplete_arms(direct, options)
    return compared(run, panel.arms, common=options.common and not early.any(), lacking=lacking)


def incomplete_arms(arms: Sequence[Arm], options: Options) -> dict[int, str]:
    """What each incomplete arm lacks, by index. Where `--trials` says how many trials were scheduled, those
    without a row are failures; the logs of a sequential comparison are still growing."""
    if options.common or options.sequential:
        return {}
    found = {p: arm.missing for p, arm in enumerate(arms) if arm.missing}
    if options.scheduled is not None:
        return {p: lack.scenarios for p, lack in found.items() if lack.scenarios}
    return {p: lack.words for p, lack in found.items()}
