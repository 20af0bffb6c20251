"""`roborecover demo`: its runs of `lerobot-eval`, resuming, progress, table and page."""

import ast
import json
import pickle
import re
import subprocess
import sys
import time
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from lerobot_roborecover.analysis.pages import pictures
from lerobot_roborecover.cli import main as cli
from lerobot_roborecover.datasets import load_scenarios
from lerobot_roborecover.demo import DemoError
from lerobot_roborecover.demo.evaluate import eval_command
from lerobot_roborecover.demo.page import write_page
from lerobot_roborecover.demo.run import run_demo, spread
from lerobot_roborecover.demo.settings import DemoSettings, claim_folder, hold_folder
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.scenario import Outcome
from lerobot_roborecover.utils.determinism import policy_kernels
from tests.support.demo_rows import rows_of
from tests.support.exactness import row_as_recorded
from tests.support.factories import fake_scenario, save_policy
from tests.support.processes import PATIENCE_S
from tests.support.shipped_policies import CHECKPOINT

STAND_IN = '''
"""Writes the rows that lerobot-eval would; argument FAIL_AFTER ends it early, as a crash would."""
import os
import sys
from pathlib import Path
from lerobot_roborecover.datasets import load_scenarios
from lerobot_roborecover.logs.trial_log import TrialLog
from lerobot_roborecover.logs.row import EvalProtocol, make_row
from lerobot_roborecover.scenario import Outcome

fail_after = int(sys.argv[1])
env_type = sys.argv[sys.argv.index("--env") + 1]
given = dict(a[2:].split("=", 1) for a in sys.argv[2:] if a.startswith("--") and "=" in a)
assert env_type == "roborecover_fake", env_type
out = Path(given["output_dir"])
(out / "calls").open("a").write("x")
start = given["env.start"]
(out / "environment").write_text(repr(dict(os.environ)))
log = TrialLog(Path(given["env.trial_log"]))
policy = given["policy.path"]
protocol = EvalProtocol(start=start, rewind_steps=0, policy=policy, run_seed=1000, execution_horizon=2)
written = 0
for index, scenario in enumerate(load_scenarios(given["env.scenarios"], select=given["env.select"])):
    for trial in range(int(given["eval.n_episodes"])):
        solved = start == "initial" or index % 2 == 0
        row = make_row(
            scenario, protocol, dataset="x", dataset_revision=None, trial=trial, batch_size=1,
            noise="per_trial", outcome=Outcome.SUCCESS if solved else Outcome.HORIZON, reason="",
            steps=7 if solved else scenario.task.horizon, handoff=None, sim_s=0.0, policy_s=0.0,
            actions_sha256="",
        )
        if log.find(row.key()):
            continue
        if written == fail_after:
            print("RuntimeError: the stand-in gives up")
            for done in range(40):
                print(f"Stepping: {done:3}%|#   | {done}/100 [00:01<00:09, 9.9it/s]", end="\\r")
                print(f"\\nRunning rollout: {done}it [00:01, 9.9it/s]")
            sys.exit(3)
        log.append(row)
        written += 1
(out / "eval_info.json").write_text("{}")
'''


@pytest.fixture
def settings(tmp_path, dataset):
    stand_in = tmp_path / "stand_in.py"
    stand_in.write_text(STAND_IN)

    def make(*, fail_after: int = -1, **changes) -> DemoSettings:
        given = {
            "policy": "some/policy",
            "scenarios": str(dataset),
            "trials": 2,
            "pictures": False,
            "program": (sys.executable, str(stand_in), str(fail_after)),
        }
        return DemoSettings(out=tmp_path / "out", **given | changes)

    return make


def test_command_is_the_one_a_user_would_type(settings, tmp_path):
    command = eval_command(settings(program=()), "metaworld", ["a", "b"], "initial")
    assert Path(command[0]).name == "lerobot-eval"
    assert command[1:3] == ["--env", "roborecover_metaworld"]
    assert {
        "--env.start=initial",
        "--env.select=id=a|b",
        "--env.obs_type=state",
        "--policy.path=some/policy",
        "--eval.n_episodes=2",
        "--eval.batch_size=2",
        f"--env.trial_log={tmp_path / 'out' / 'trials.jsonl'}",
        f"--output_dir={tmp_path / 'out' / 'initial'}",
    } < set(command)


@pytest.mark.nightly
def test_the_policy_rounds_as_on_other_machines(settings, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.setenv("MKL_CBWR", "AUTO")
    run_demo(settings())
    for start in ("recovery", "initial"):
        seen = ast.literal_eval((settings().out / start / "environment").read_text())
        assert {k: seen[k] for k in policy_kernels()} == policy_kernels()


@pytest.mark.slow
def test_both_starts_are_run_and_reported(settings, capsys):
    page = run_demo(settings())
    out = capsys.readouterr().out
    assert re.search(r"Initial-state success +100\.0 .* 4 +8 +0\n", out)
    assert re.search(r"Recovery success \(RSR\) +50\.0 .* 4 +8 +0\n", out)
    assert str(page) in out
    text = page.read_text()
    assert text.count('class="card"') == 4
    assert "some/policy" in text
    rows = read_trial_log(settings().trial_log)
    assert len(rows) == 16
    assert {r.start for r in rows} == {"recovery", "initial"}


@pytest.mark.nightly
@pytest.mark.slow
def test_a_finished_demo_runs_nothing_again(settings):
    run_demo(settings())
    before = settings().trial_log.read_bytes()
    run_demo(settings())
    assert settings().trial_log.read_bytes() == before
    assert (settings().out / "recovery" / "calls").read_text() == "x"
    run_demo(settings(trials=3))
    assert len(read_trial_log(settings().trial_log)) == 24


@pytest.mark.nightly
@pytest.mark.slow
def test_a_failed_run_shows_the_end_of_its_output_and_goes_on_when_rerun(settings, capsys):
    with pytest.raises(
        DemoError,
        match=r"(?s)status 3 after 3 of 8 trials: RuntimeError: the stand-in gives up\n.*same command",
    ) as failed:
        run_demo(settings(fail_after=3))
    assert "it/s" not in str(failed.value)
    assert len(read_trial_log(settings().trial_log)) == 3
    run_demo(settings())
    assert len(read_trial_log(settings().trial_log)) == 16
    assert "RSR) " in capsys.readouterr().out


@pytest.mark.nightly
def test_a_killed_demo_leaves_no_run_behind_that_holds_the_log(settings, tmp_path):
    child = tmp_path / "child"
    hangs = tmp_path / "hangs.py"
    hangs.write_text(
        "import os, pathlib, time\n"
        "from lerobot_roborecover.logs.trial_log import TrialLog\n"
        f"log = TrialLog(pathlib.Path({str(settings().trial_log)!r}))\n"
        f"pathlib.Path({str(child)!r}).write_text(f'{{os.getpid()}} ')\n"
        "time.sleep(600)\n"
    )
    given = pickle.dumps(settings(program=(sys.executable, str(hangs))))
    code = f"import pickle, lerobot_roborecover.demo.run as demo; demo.run_demo(pickle.loads({given!r}))"
    process = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.DEVNULL)
    while not (child.exists() and child.read_text()) and process.poll() is None:
        time.sleep(0.02)
    process.kill()
    process.wait()
    deadline = time.monotonic() + PATIENCE_S
    while Path(f"/proc/{child.read_text().strip()}").exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    run_demo(settings())
    assert len(read_trial_log(settings().trial_log)) == 16


@pytest.mark.nightly
def test_only_selected_scenarios_are_run_and_counted(settings, capsys):
    run_demo(settings(limit=2))
    assert {r.scenario_id for r in read_trial_log(settings().trial_log)} == {
        "fake-push-left-000",
        "fake-push-left-002",
    }
    run_demo(settings(select="task=push-right", limit=1))
    assert re.search(r"Recovery success \(RSR\) .* 1 +2 +0\n", capsys.readouterr().out)


def test_limit_spreads_over_the_set():
    assert spread(range(24), 6) == [0, 4, 8, 12, 16, 20]
    assert spread(range(3), 5) == spread(range(3), None) == [0, 1, 2]


def test_a_folder_of_another_policy_is_refused(settings, tmp_path):
    claim_folder(settings())
    claim_folder(settings(trials=5))
    with pytest.raises(DemoError, match=r"policy 'some/policy', not 'another'.*--out"):
        claim_folder(settings(policy="another"))
    (tmp_path / "out" / "demo.json").write_text("[]")
    with pytest.raises(DemoError, match="--out"):
        claim_folder(settings())


def test_two_demos_in_one_folder_are_kept_apart(settings, tmp_path):
    with hold_folder(settings()):
        with pytest.raises(DemoError, match=r"another demo is at work in .*out\. Wait for it.*--out FOLDER"):
            run_demo(settings())
        assert not (tmp_path / "out" / "recovery").exists()
    with hold_folder(settings()):
        pass


def test_bad_input_ends_with_one_line_and_status_2(settings, tmp_path, capsys, dataset):
    def refused(*args: str) -> str:
        assert cli.main(["demo", "--out", str(tmp_path / "o"), "--policy.path", CHECKPOINT, *args]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line

    assert "--trials 0" in refused("--trials", "0")
    assert "--limit 0" in refused("--limit", "0")
    assert "no/such" in refused("--scenarios", str(tmp_path / "no/such"))
    assert "matches none" in refused("--scenarios", str(dataset), "--select", "task=none")
    assert not (tmp_path / "o").exists()


class Page(HTMLParser):
    """What a page would load."""

    def __init__(self, text: str):
        super().__init__()
        self.links: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.links += [attrs[name] for name in ("src", "href", "srcset") if name in attrs]

    @property
    def pictures(self) -> list[str]:
        return [link for link in self.links if link.startswith("data:image/jpeg")]


@pytest.mark.slow
def test_the_page_is_the_report_of_the_log_with_its_pictures(dataset, tmp_path):
    a, b, c, d = (s.id for s in load_scenarios(str(dataset)))
    rows = rows_of(
        dataset, {a: ["success", "horizon"], b: ["sim_error"] * 2, c: ["horizon"] * 2, d: ["success"] * 2}
    )
    rows += rows_of(dataset, {a: ["success"]}, start="initial")
    log = tmp_path / "trials.jsonl"
    log.write_text("".join(json.dumps(row) + "\n" for row in rows))
    frame = tmp_path / "a.jpg"
    frame.write_bytes(b"a picture")
    page = write_page(
        log, tmp_path / "out", wanted=lambda row: row.scenario_id != d, trials=2, frames={a: frame},
        problem="no <OpenGL> here", commands=["lerobot-eval"],
    )  # fmt: skip
    text = page.read_text()
    shown = Page(text)
    assert shown.pictures == ["data:image/jpeg;base64,YSBwaWN0dXJl"]
    assert all(link.startswith(("data:", "#")) for link in shown.links)
    assert "url(" not in text
    assert text.count('<li class="card"') == 3
    assert "RoboRecover demo" in text
    assert "hands the scene to the policy" in text
    assert "no &lt;OpenGL&gt; here" in text
    assert "the &lt;worker&gt; died" in text
    assert "●○" in text
    assert "from the initial state 1 of 1" in text


def test_pictures_of_the_recovery_points(dataset, tmp_path):
    from PIL import Image

    scenarios = list(load_scenarios(str(dataset)))[:2]
    files, problem = pictures.render_frames(scenarios, tmp_path)
    assert problem == ""
    assert set(files) == {s.id for s in scenarios}
    sizes = {Image.open(path).size for path in files.values()}
    assert len(sizes) == 1
    changed = {path: path.stat().st_mtime_ns for path in files.values()}
    assert pictures.render_frames(scenarios, tmp_path) == (files, "")
    assert changed == {path: path.stat().st_mtime_ns for path in files.values()}


@pytest.mark.parametrize(("name", "why"), [("raises", "broke on purpose"), ("exits", "process died")])
def test_pictures_that_cannot_be_rendered_say_why(tmp_path, name, why):
    whole = fake_scenario(0, name=name, suite="faults", steps=10)
    broken = replace(whole, prefix=np.zeros((25, 2)), fingerprint=None)
    files, problem = pictures.render_frames([broken], tmp_path)
    assert files == {}
    assert why in problem


@pytest.mark.lerobot
def test_lerobot_eval_takes_the_command(dataset, tmp_path, monkeypatch):
    """In this process; as a process of its own it is in the nightly run."""
    from lerobot.scripts.lerobot_eval import eval_main

    import lerobot_roborecover.plugin as plugin

    policy = save_policy(tmp_path / "act")
    asked = DemoSettings(tmp_path / "out", str(policy), str(dataset), trials=2)
    claim_folder(asked)
    ids = [s.id for s in load_scenarios(str(dataset))][:2]
    _, *arguments = eval_command(asked, "fake", ids, "initial")
    monkeypatch.setattr(sys, "argv", plugin.rewrite_env_argument(["lerobot-eval", *arguments]))
    eval_main()
    rows = read_trial_log(asked.trial_log)
    assert [(r.scenario_id, r.start) for r in rows] == [(i, "initial") for i in ids for _ in range(2)]


@pytest.mark.nightly
@pytest.mark.lerobot
@pytest.mark.slow
def test_through_lerobot_eval_itself(dataset, tmp_path, capsys):
    policy = save_policy(tmp_path / "act")
    arguments = ["--out", str(tmp_path / "out"), "--policy.path", str(policy), "--scenarios", str(dataset)]
    assert cli.main(["demo", *arguments, "--limit", "2", "--trials", "2"]) == 0
    assert "Left out of Macro, with fewer than 7 scenarios" in capsys.readouterr().out
    for start in ("recovery", "initial"):
        info = json.loads((tmp_path / "out" / start / "eval_info.json").read_text())
        assert info["overall"]["n_episodes"] == 4
    assert len(Page((tmp_path / "out" / "report.html").read_text()).pictures) == 2


@pytest.mark.nightly
@pytest.mark.metaworld
@pytest.mark.lerobot
@pytest.mark.render
@pytest.mark.slow
def test_the_shipped_policy_on_shipped_scenarios(tmp_path, capsys):
    assert cli.main(["demo", "--out", str(tmp_path), "--limit", "2"]) == 0
    assert "Recovery success (RSR)" in capsys.readouterr().out
    rows = read_trial_log(tmp_path / "trials.jsonl")
    assert {r.start for r in rows} == {"recovery", "initial"}
    assert all(Outcome(r.outcome).valid for r in rows), [r.reason for r in rows]
    assert all(row_as_recorded(r) for r in rows if r.start == "recovery")
    assert len(Page((tmp_path / "report.html").read_text()).pictures) == 2
