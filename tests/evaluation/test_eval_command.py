"""`roborecover eval` as a user types it: resume, limits, Ctrl-C, shards, videos, and refusals."""

from __future__ import annotations

import errno
import json
import os
import shlex
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import av
import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.datasets import write_scenarios
from lerobot_roborecover.evaluation.arms import NESTED
from lerobot_roborecover.evaluation.progress import ProgressLine
from lerobot_roborecover.logs.trial_log import read_trial_log
from tests.support.factories import fake_dataset, fake_scenario, save_policy
from tests.support.loop import outcomes
from tests.support.processes import PATIENCE_S, alive_after, children
from tests.support.stock_eval import lerobot_eval

pytestmark = pytest.mark.lerobot

TRIALS = 3
COUNT = 4
HORIZON = 20


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return fake_dataset(tmp_path_factory.mktemp("fake") / "set", COUNT, horizon=HORIZON)


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    return save_policy(tmp_path_factory.mktemp("policy"), "diffusion")


@pytest.fixture
def arguments(dataset, policy):
    return [
        "--env", "roborecover_fake", f"--env.scenarios={dataset}", f"--policy.path={policy}",
        "--policy.device=cpu", f"--eval.n_episodes={TRIALS}", "--runner.slots=2",
    ]  # fmt: skip


@pytest.fixture
def run(arguments, tmp_path):
    """Runs the command in this process; returns its output folder."""

    def call(*extra: str, out: str = "out", status: int = 0) -> Path:
        assert main(["eval", *arguments, f"--output_dir={tmp_path / out}", *extra]) == status
        return tmp_path / out

    return call


@pytest.fixture(scope="module")
def whole(dataset, policy, tmp_path_factory):
    """The rows of stock `lerobot-eval --eval.batch_size=1`."""
    return stock(dataset, policy, tmp_path_factory.mktemp("stock"))


def stock(dataset, policy, out, *extra):
    lerobot_eval(
        out, "--env", "roborecover_fake", f"--env.scenarios={dataset}", f"--policy.path={policy}",
        f"--eval.n_episodes={TRIALS}", "--eval.batch_size=1", "--eval.use_async_envs=false", *extra,
    )  # fmt: skip
    return outcomes(rows_of(out))


def rows_of(out: Path):
    return read_trial_log(out / "trials.jsonl")


def test_the_same_rows_as_lerobot_eval(run, whole, capsys, monkeypatch):
    out = run()
    rows = rows_of(out)
    assert outcomes(rows) == whole
    assert {(r.execution_horizon, r.noise, r.run_seed) for r in rows} == {(4, "per_trial", 1000)}
    info = json.loads((out / "eval_info.json").read_text())
    assert info["overall"]["n_episodes"] == COUNT * TRIALS
    by_id = {t["task_id"]: t["metrics"]["successes"] for t in info["per_task"]}
    assert all(by_id[r.scenario_id][r.trial] == r.success for r in rows)
    shown = capsys.readouterr().out
    assert "Recovery success (RSR)" in shown
    named = f"next: roborecover report {out} --out {out / 'report'}"
    assert shown.splitlines()[-3] == named
    again, both = (shlex.split(line.partition(": roborecover ")[2]) for line in shown.splitlines()[-2:])
    assert {"--env.start=initial", f"--output_dir={out}-initial"} <= set(again)
    assert "Loading weights" not in shown
    monkeypatch.setenv(NESTED, "1")
    run()
    assert "next: " not in capsys.readouterr().out, "the outer command says what comes next"
    assert main(shlex.split(named)[2:]) == 0
    assert (out / "report" / "report.html").exists()
    assert main(again) == 0
    assert {r.start for r in rows_of(Path(f"{out}-initial"))} == {"initial"}
    assert main(both) == 0
    assert "from initial states" in capsys.readouterr().out


@pytest.mark.nightly
def test_real_time_is_the_same_under_lerobot_eval(run, whole, dataset, policy, tmp_path):
    """A policy that is asked step by step, four actions an inference."""
    slow = ("--env.realtime=true", "--env.latency_s=0.1")
    rows = rows_of(run(*slow))
    assert outcomes(rows) == stock(dataset, policy, tmp_path / "stock", *slow) != whole
    assert {(r.options["realtime"], r.options["latency_s"]) for r in rows} == {("hold", 0.1)}


@pytest.mark.nightly
def test_a_rerun_repeats_nothing(run, whole):
    log = run() / "trials.jsonl"
    before = log.read_bytes()
    log.write_bytes(b"".join(before.splitlines(keepends=True)[:5]))
    run()
    assert log.read_bytes().startswith(b"".join(before.splitlines(keepends=True)[:5]))
    assert outcomes(read_trial_log(log)) == whole
    full = log.read_bytes()
    run()
    assert log.read_bytes() == full


@pytest.mark.nightly
def test_shards_come_together(run, whole, tmp_path, capsys):
    logs = [str(run(f"--shard={k}/2", out=f"s{k}") / "trials.jsonl") for k in range(2)]
    assert "incomplete: 2 of 4 scenarios; shard 0/2 is missing" in capsys.readouterr().out
    rows = [row for log in logs for row in read_trial_log(Path(log))]
    assert {(r.run_scenarios, r.run_trials, r.shard) for r in rows} == {(4, 3, "0/2"), (4, 3, "1/2")}
    merged = tmp_path / "merged.jsonl"
    assert main(["merge", *logs, "--out", str(merged)]) == 0
    assert outcomes(read_trial_log(merged)) == whole


@pytest.mark.nightly
def test_sequential_alone_and_against_a_log(run, whole, capsys):
    other = run("--sequential")
    assert outcomes(rows_of(other)) == whole
    assert f"on {COUNT} of {COUNT} scenarios" in capsys.readouterr().err
    out = run("--sequential", str(other), out="against")
    assert outcomes(rows_of(out)) == whole
    assert "not decided against" in capsys.readouterr().out
    record = json.loads((out / "trials.sequential.json").read_text())
    assert (record["decided"], record["after_scenarios"], record["p"]) == (False, COUNT, 1.0)
    run(f"--sequential={other}", "--shard=0/2", out="shard", status=2)
    assert "a part cannot decide for the whole" in capsys.readouterr().err


@pytest.mark.nightly
def test_a_time_limit_stops_cleanly_and_says_how_to_go_on(run, whole, capsys):
    slow = "--env.step_s=0.02"
    out = run(slow, "--limit-seconds=3")
    assert len(rows_of(out)) < COUNT * TRIALS
    assert "time limit reached" in capsys.readouterr().err
    run(slow)
    assert outcomes(rows_of(out)) == whole


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """The temporary folder of this process and its children."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.setattr("tempfile.tempdir", None)
    return folder


@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGTERM, 143), pytest.param(signal.SIGHUP, 129, marks=pytest.mark.nightly)]
)
def test_stop_signals_leave_a_log_that_a_rerun_completes(
    run, whole, monkeypatch, capsys, temporary, request, number, status
):
    """A scheduler's, and a closed terminal's, which nohup would have ignored; Ctrl-C's is below."""
    show, shown = ProgressLine.show, []

    def shows(self, *arguments, **options):
        show(self, *arguments, **options)
        shown.append(1)
        if len(shown) == 3:  # before the first trial, and after two
            signal.raise_signal(number)

    monkeypatch.setattr(ProgressLine, "show", shows)
    request.addfinalizer(partial(signal.signal, number, signal.signal(number, signal.SIG_DFL)))
    out = run(status=status)
    assert len(rows_of(out)) == 2
    assert "interrupted: 2 of 12 trials done; to go on, run the same command" in capsys.readouterr().err
    assert (out / "eval_info.json").exists()
    assert list(temporary.glob("roborecover-*")) == []
    run()
    assert outcomes(rows_of(out)) == whole


def test_a_full_disk_is_one_line_and_keeps_finished_trials(run, whole, tmp_path, monkeypatch, capsys):
    log, write = tmp_path / "out" / "trials.jsonl", os.write

    def full(number: int, data: bytes) -> int:
        """Half of the fifth row fits."""
        done = log.read_bytes().count(b"\n") if log.exists() else 0
        if done < 4 or not os.path.samestat(os.fstat(number), log.stat()):
            return write(number, data)
        if not log.read_bytes().endswith(b"\n"):
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(number, data[: len(data) // 2])

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", full)
        out = run(status=2)
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith(f"roborecover eval: {log}: No space left on device. Make room ")
    assert line.endswith("Finished trials are kept")
    finished = log.read_bytes()
    assert finished.count(b"\n") == 4
    assert finished.endswith(b"\n"), "no half row"
    run()
    assert log.read_bytes().startswith(finished)
    assert outcomes(rows_of(out)) == whole


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_ctrl_c_or_a_kill_leaves_a_log_that_a_rerun_completes(
    run, whole, arguments, tmp_path, temporary, how
):
    out = tmp_path / "out"
    log = out / "trials.jsonl"
    command = [sys.executable, "-m", "lerobot_roborecover.cli.main", "eval", *arguments]
    command += [f"--output_dir={out}", "--env.step_s=0.02"]
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, start_new_session=True
    )
    deadline = time.monotonic() + PATIENCE_S
    while not (log.exists() and log.read_bytes().count(b"\n") >= 2) and time.monotonic() < deadline:
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.02)
    simulators = children(process)
    if how is signal.SIGINT:
        os.killpg(process.pid, how)  # a terminal sends it to the whole group, simulators included
    else:
        process.kill()
    _, errors = process.communicate(timeout=PATIENCE_S)
    assert "Traceback" not in errors
    if how is signal.SIGINT:
        assert process.returncode == 130, errors
        assert "interrupted" in errors
    assert len(simulators) == 2
    assert not alive_after(simulators)
    assert len(list(temporary.glob("roborecover-snapshots-*"))) == (how is signal.SIGKILL)
    finished = log.read_bytes()
    finished = finished[: finished.rfind(b"\n") + 1]
    assert 2 <= finished.count(b"\n") < COUNT * TRIALS
    run("--env.step_s=0.02")
    assert log.read_bytes().startswith(finished), "a finished trial was lost or repeated"
    assert outcomes(rows_of(out)) == whole
    assert list(temporary.glob("roborecover-*")) == []


def videos(out: Path) -> dict[str, int]:
    """Frames of each video."""
    found = {}
    for path in sorted((out / "videos").iterdir()):
        with av.open(str(path)) as container:
            found[path.name] = sum(1 for _ in container.decode(video=0))
    return found


def test_videos_of_failures_are_bounded_and_whole(run, whole):
    out = run("--videos=3", "--env.obs_type=state")
    found = videos(out)
    assert len(found) == 3
    assert all(name.endswith("_horizon.mp4") for name in found)
    assert set(found.values()) == {HORIZON + 1}, "the handoff and every step"
    assert outcomes(rows_of(out)) == whole, "recording changes nothing"
    info = json.loads((out / "eval_info.json").read_text())
    paths = [p for task in info["per_task"] for p in task["metrics"]["video_paths"]]
    assert sorted(Path(p).name for p in paths) == sorted(found)


def test_videos_of_chosen_scenarios(run, capsys):
    chosen, said = fake_scenario(1).id, "of 9: trials that the log had already are not run again"
    found = videos(run("--videos=9", f"--runner.videos_of={chosen}"))
    assert found
    assert all(name.startswith(chosen) for name in found)
    assert said not in capsys.readouterr().err
    assert videos(run("--videos=9", f"--runner.videos_of={fake_scenario(2).id}")) == found
    assert f"{len(found)} videos {said}" in capsys.readouterr().err


@pytest.mark.nightly
def test_a_run_with_images_has_videos_of_every_start(run):
    """Without an option: the same scenarios for every policy; initial trials are kept beside the others."""
    pictures = "--env.obs_type=pixels_agent_pos"
    found = videos(run(pictures))
    ids = sorted(fake_scenario(i).id for i in range(COUNT))
    assert [name.split("_trial0_")[0] for name in found] == ids
    out = run(pictures, "--env.start=initial")
    every = videos(out)
    assert found.items() <= every.items(), "nothing was overwritten"
    assert [n.split("_initial_trial0_")[0] for n in sorted(set(every) - set(found))] == ids
    info = json.loads((out / "eval_info.json").read_text())
    paths = [p for task in info["per_task"] for p in task["metrics"]["video_paths"]]
    assert {Path(p).name for p in paths} == set(every) - set(found)
    assert not (run(out="state") / "videos").exists(), "a state-only run renders nothing"
    assert not (run(pictures, "--videos=0", out="none") / "videos").exists()


@pytest.mark.nightly
def test_without_videos_nothing_is_rendered(run, monkeypatch, tmp_path):
    """Workers are fresh interpreters: a package ahead of ours on their path counts the renders."""
    site = tmp_path / "site"
    site.mkdir()
    marks = tmp_path / "rendered"
    (site / "sitecustomize.py").write_text(
        "import lerobot_roborecover.platforms.fake.simulator as fake\n"
        "draw = fake.FakeSimulator.render\n"
        "def render(self):\n"
        f"    open({str(marks)!r}, 'a').write('x')\n"
        "    return draw(self)\n"
        "fake.FakeSimulator.render = render\n"
    )
    monkeypatch.syspath_prepend(str(site))
    run()
    assert not marks.exists()
    run("--videos=1", out="recorded")
    assert marks.stat().st_size >= HORIZON


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        (["--engine=slurm"], r"engine=slurm: not one of"),
        (["--runner.slots=-1"], "slots=-1: must be from 0"),
        (["--videos=1", "--runner.videos_of=nobody"], "'nobody' is neither one of"),
        (["--videos=1", "--runner.render_device=99"], "render_device=99"),
        (["--shard=7/7"], "0 <= k < n"),
        (["--eval.recording=true"], "--videos=N"),
        (["--env.latency_s=0.1"], "--env.realtime=true only"),
        (["--env.realtime=true", "--env.during_inference=chunk"], "4 actions of an inference one by one"),
    ],
)
def test_refusals_are_one_line_and_run_nothing(run, capsys, extra, words):
    import re

    out = run(*extra, status=2)
    errors = capsys.readouterr().err.splitlines()
    assert re.search(words, errors[-1])
    assert not (out / "eval_info.json").exists()


def test_a_simulator_that_cannot_be_made_is_refused_before_the_first_trial(run, capsys, monkeypatch):
    from lerobot_roborecover.evaluation import env_configs

    monkeypatch.setattr(
        env_configs.ENV_TYPES["fake"], "gym_kwargs", property(lambda self: {"obs_type": "smell"})
    )
    out = run(status=2)
    assert "because the first simulator failed" in capsys.readouterr().err
    assert rows_of(out) == []


def test_a_broken_picture_is_refused_before_the_first_trial(run, capsys, dataset, monkeypatch, tmp_path):
    site = tmp_path / "site"
    site.mkdir()
    (site / "sitecustomize.py").write_text(
        "import lerobot_roborecover.platforms.fake.simulator as fake\n"
        "def render(self):\n"
        "    raise RuntimeError('no OpenGL context')\n"
        "fake.FakeSimulator.render = render\n"
    )
    monkeypatch.syspath_prepend(str(site))
    out = run("--videos=1", status=2)
    errors = capsys.readouterr().err
    assert "no OpenGL context" in errors
    assert "render_device=cpu" in errors
    assert rows_of(out) == []


def test_a_scenario_that_breaks_does_not_stop_the_run(run, tmp_path):
    root = write_scenarios(
        tmp_path / "set",
        [
            fake_scenario(0, horizon=HORIZON),
            fake_scenario(1, name="raises", suite="faults", horizon=HORIZON),
        ],
    )
    rows = rows_of(run(f"--env.scenarios={root}", "--videos=1"))
    by_suite = {s: {r.outcome for r in rows if r.suite == s} for s in ("toy", "faults")}
    assert by_suite["faults"] == {"sim_error"}
    assert by_suite["toy"] <= {"success", "horizon"}
    assert len(rows) == 2 * TRIALS
