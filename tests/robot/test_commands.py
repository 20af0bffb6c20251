"""The commands of robots refuse in one line; tests/docs/test_robots_page.py has the whole evening."""

from __future__ import annotations

import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.robot.points import write_points
from tests.support.robot_points import made_point, pictures_of

pytestmark = pytest.mark.lerobot
LAB = ("--robot.type=roborecover_lab", "--robot.id=lab", "--robot.realtime=false", "--operator=simulated")


def refused(capsys, *words: str) -> str:
    assert main(["robot", *words]) == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert line.startswith(f"roborecover robot {words[0]}: ")
    return line


def test_what_cannot_be_used_is_one_line(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "no policy: give a checkpoint with --policy.path" in refused(capsys, "capture", *LAB)
    assert "--rater: say who gives the verdicts" in refused(capsys, "run", *LAB, "--plan=plan.yaml")
    assert "plan.yaml" in refused(capsys, "run", *LAB, "--plan=plan.yaml", "--rater=kim")
    (tmp_path / "plan.yaml").write_text("points: points\npolicies: {a: {}}\n")
    assert "policy 'a': its path is needed" in refused(capsys, "run", *LAB, "--plan=plan.yaml", "--rater=kim")
    limits = "--limits={x.pos: [3, 1]}"
    assert "is not a lowest and a highest position" in refused(capsys, "restore", *LAB, limits)
    assert "--operator=robot: not 'simulated'" in refused(capsys, "restore", *LAB[:3], "--operator=robot")
    write_points("points", [made_point("a")], {"a": pictures_of(0)})
    line = refused(capsys, "restore", *LAB, "--points=points")
    assert "point a is of robot 'so101_follower', this one is 'roborecover_lab'" in line
    assert "has no point 'b'; it has a" in refused(capsys, "restore", *LAB, "--points=points", "--point=b")
    assert "is no LeRobotDataset" in refused(capsys, "points", "nothing", "--out", "p", "--quasi-static")
    assert "cannot read trial log" in refused(capsys, "rate", "nothing")
