"""What several files of robots' tests need."""

from __future__ import annotations

import pytest

from lerobot_roborecover.robot.console import Console
from lerobot_roborecover.robot.recorder import marks
from tests.support.robot_lab import lab, scripted

FPS = 20


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Policies, and two recovery points of episodes that were captured on the lab."""
    from lerobot_roborecover.robot.capture import capture
    from lerobot_roborecover.robot.episodes import Episodes, PointRequest
    from lerobot_roborecover.robot.lab.operator import SimulatedOperator
    from lerobot_roborecover.robot.points import write_points
    from lerobot_roborecover.robot.policies import load_context

    root = tmp_path_factory.mktemp("robot")
    scripted(root / "good", size=48)
    scripted(root / "worse", size=48, bias_mm=200.0)
    with lab(root) as robot:
        context = load_context(robot, str(root / "worse"), fps=FPS, instruction=robot.instruction)
        found = capture(
            robot, context, root / "cube", Console(SimulatedOperator(robot)), episodes=2, limit_s=5.0,
            instruction=robot.instruction, say=lambda line: None,
        )  # fmt: skip
    assert found == 2
    episodes = Episodes(root / "cube")
    both = [
        episodes.point(
            PointRequest(m["episode"], m["frame"], "Approach", "Wrong Pose", quasi_static=True), 6.0
        )
        for m in marks(root / "cube")
    ]
    write_points(root / "points", [s for s, _ in both], {s.id: p for s, p in both})
    return root
