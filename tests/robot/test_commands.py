"""The commands of robots refuse in one line; tests/docs/test_robots_page.py has the whole evening."""

from __future__ import annotations

import json
import os
import re
import shlex
import sys
from itertools import count

import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.robot.plan import lock_plan, parse_plan
from lerobot_roborecover.robot.points import write_points
from tests.support.doc_blocks import ROOT
from tests.support.factories import save_policy
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
    keys = ("--keys={b: mork}", "--keys={f13: mark}")
    assert "no button 'mork'; there are stop, go" in refused(capsys, "restore", *LAB, keys[0])
    assert "'f13' is no key: write one character" in refused(capsys, "restore", *LAB, keys[1])
    assert "--operator=robot: not 'simulated'" in refused(capsys, "restore", *LAB[:3], "--operator=robot")
    write_points("points", [made_point("a")], {"a": pictures_of(0)})
    line = refused(capsys, "restore", *LAB, "--points=points")
    assert "point a is of robot 'so101_follower', this one is 'roborecover_lab'" in line
    assert "has no point 'b'; it has a" in refused(capsys, "restore", *LAB, "--points=points", "--point=b")
    assert "is no LeRobotDataset" in refused(capsys, "points", "nothing", "--out", "p", "--quasi-static")
    assert "cannot read trial log" in refused(capsys, "rate", "nothing")


def test_policies_of_a_plan_are_checked_before_lerobot_is_imported(tmp_path, capsys):
    save_policy(tmp_path / "act", "act")
    save_policy(tmp_path / "pi", "act")
    plan = tmp_path / "plan.yaml"
    words = ("run", *LAB, f"--plan={plan}", "--rater=kim", f"--out={tmp_path / 'run'}")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "lerobot_roborecover.robot.commands", None)  # whose import is LeRobot's
        content = {"points": "points", "policies": {"a": str(tmp_path / "act"), "b": str(tmp_path / "pj")}}
        plan.write_text(json.dumps(content))
        line = refused(capsys, *words)
        assert f"plan: policy 'b': --policy.path={tmp_path / 'pj'}" in line
        assert "there is no such folder" in line
        content["policies"]["b"] = {"path": str(tmp_path / "pi"), "overrides": ["--n_acton_steps=2"]}
        plan.write_text(json.dumps(content))
        line = refused(capsys, *words)
        assert "plan: policy 'b': there is no option --policy.n_acton_steps" in line
        assert "n_action_steps" in line
    write_points(tmp_path / "points", [made_point("a")], {"a": pictures_of(0)})
    with pytest.raises(OptionError, match="n_action_steps"):
        lock_plan(parse_plan({**content, "points": str(tmp_path / "points")}), tmp_path / "run")
    assert not (tmp_path / "run").exists(), "what was refused is not locked, so that it can be mended"


def test_a_pedal_is_a_key_of_the_terminal(monkeypatch, capsys):
    from lerobot_roborecover.robot.commands import _keyboard
    from lerobot_roborecover.robot.console import Console

    keyboard, terminal = os.openpty()
    console = Console(seconds=count(0.0, 10.0).__next__)  # no key is pressed at once
    console.show("capturing", "", ("mark", "end"))
    with os.fdopen(terminal) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        listener = _keyboard(console, {"b": "mark"})
        try:
            os.write(keyboard, b"xb ")
            while not console.stopped:
                pass
        finally:
            listener.stop()
            os.close(keyboard)
    assert console.poll().button == "mark"
    assert console.poll() is None
    assert "b=mark" in capsys.readouterr().out


def test_the_pages_options_of_an_so101_are_lerobots(tmp_path, capsys, monkeypatch):
    import draccus

    from lerobot_roborecover.robot.commands import CaptureConfig, register_hardware

    page = (ROOT / "docs" / "robots.md").read_text()
    (words,) = re.findall(r"ROBOT=\((.*?)\)\n", page, re.S)
    options = shlex.split(words)
    register_hardware()
    config = draccus.parse(CaptureConfig, args=[*options, "--teleop.type=so101_leader", "--teleop.port=x"])
    kinds = (type(config.robot).__name__, type(config.teleop).__name__)
    assert kinds == ("SOFollowerRobotConfig", "SOLeaderTeleopConfig")
    assert {name: camera.index_or_path for name, camera in config.robot.cameras.items()} == {
        "top": 0,
        "wrist": 2,
    }
    # Without the arm, or without its bus's package, that is one line.
    monkeypatch.chdir(tmp_path)
    write_points("points", [made_point("a")], {"a": pictures_of(0)})
    line = refused(capsys, "restore", *options, "--points=points", "--robot.calibration_dir=calibration")
    assert "--robot.type: 'feetech-servo-sdk' is required" in line or "cannot be connected" in line
