"""`roborecover doctor`: what it finds, what it says about it, and the exit status."""

import json
import subprocess
import sys
from importlib import metadata
from urllib.error import URLError

import pytest

from lerobot_roborecover import doctor
from lerobot_roborecover.cli import main as cli
from lerobot_roborecover.doctor import machine, software, sources
from lerobot_roborecover.platforms import probe, versions
from lerobot_roborecover.platforms.findings import Check, Status, format_report, report_json
from lerobot_roborecover.platforms.libero import PLATFORM
from lerobot_roborecover.utils.text import install_command
from tests.support.processes import PATIENCE_S


@pytest.fixture
def installed(monkeypatch):
    """Lets a test say which distributions are installed."""

    def install(**found):
        found = {name.replace("_", "-"): version for name, version in found.items()}
        monkeypatch.setattr(versions, "installed", found.get)

    return install


GOOD = {
    "lerobot": "0.6.1",
    "mujoco": "3.3.2",
    "robosuite": "1.4.1",
    "hf_libero": "0.1.4",
    "metaworld": "3.0.0",
}


def test_accepted_versions_have_no_problems(installed):
    installed(**GOOD)
    assert versions.version_problems("libero") == []
    assert versions.version_problems("metaworld") == []


def test_a_newer_mujoco_is_named_with_the_version_to_install(installed):
    installed(**GOOD | {"mujoco": "3.4.0"})
    (problem,) = versions.version_problems("libero")
    assert "mujoco is 3.4.0" in problem
    assert "pip install 'mujoco==3.3.2'" in problem
    checks = {c.name: c for c in software.check_versions("metaworld", required=False)}
    assert checks["metaworld scores: mujoco"].status is Status.FAILURE
    assert checks["metaworld scores: metaworld"].status is Status.OK


@pytest.mark.parametrize(("required", "status"), [(False, Status.WARNING), (True, Status.FAILURE)])
def test_a_missing_platform_fails_only_when_asked_for(installed, required, status):
    installed(lerobot="0.6.1", mujoco="3.3.2")
    missing = [c for c in software.check_versions("libero", required) if c.status is not Status.OK]
    assert [(c.name.split(": ")[1], c.status) for c in missing] == [
        ("robosuite", status),
        ("hf-libero", status),
    ]
    assert all(c.remedy == install_command("libero") for c in missing)
    assert len(versions.version_problems("libero")) == 2


def test_an_unknown_platform_is_refused():
    with pytest.raises(ValueError, match="'atari'"):
        versions.version_problems("atari")


@pytest.mark.parametrize(
    ("name", "answers", "status", "text"),
    [
        (
            "lerobot_env_roborecover",
            {"discovered": True, "env_types": ["roborecover_libero"]},
            Status.OK,
            "libero",
        ),
        (
            "lerobot-env-roborecover",
            {"discovered": True, "env_types": ["x"]},
            Status.FAILURE,
            "'lerobot-env-robo",
        ),
        ("something_else", {"discovered": True, "env_types": ["x"]}, Status.FAILURE, "not installed"),
        ("lerobot_env_roborecover", {"discovered": False, "env_types": ["x"]}, Status.FAILURE, "discovery"),
        (
            "lerobot_env_roborecover",
            {"env_types": {"error": "No module 'q'"}},
            Status.FAILURE,
            "No module 'q'",
        ),
        ("lerobot_env_roborecover", {"discovered": True, "env_types": []}, Status.FAILURE, "no env type"),
        ("lerobot_env_roborecover", {"error": "no answer within 180 s"}, Status.FAILURE, "within 180 s"),
    ],
)
def test_plugin(monkeypatch, name, answers, status, text):
    class Distribution:
        def __init__(self):
            self.metadata = {"Name": name}

    monkeypatch.setattr(metadata, "distributions", lambda: [Distribution()])
    check = software.check_plugin(answers)
    assert check.status is status
    assert text in check.detail
    assert bool(check.remedy) is (status is not Status.OK)


def test_two_opencv_distributions_clash(installed):
    installed(opencv_python="5.0.0", opencv_python_headless="4.13.0.92")
    check = software.check_opencv({"cv2": "5.0.0"})
    assert check.status is Status.WARNING
    assert "pip install opencv-python-headless==4.13.0.92" in check.remedy
    broken = software.check_opencv({"cv2": {"error": "ImportError: libGL.so.1"}})
    assert broken.status is Status.FAILURE
    assert "libGL.so.1" in broken.detail
    installed(opencv_python_headless="4.13.0.92")
    assert software.check_opencv({"cv2": "4.13.0"}).status is Status.OK


def test_missing_ffmpeg_is_a_warning():
    check = software.check_ffmpeg({"torchcodec": {"error": "RuntimeError: Could not load libtorchcodec"}})
    assert check.status is Status.WARNING
    assert "apt-get install ffmpeg" in check.remedy
    assert software.check_ffmpeg({"torchcodec": "0.11.1"}).status is Status.OK


def test_opengl_names_a_backend_that_works(monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("MUJOCO_GL", "egl")
    answers = {"egl": {"error": "no EGL device"}, "osmesa": {"renderer": "llvmpipe", "correct": True}}
    monkeypatch.setattr(machine, "_render", lambda backend: answers[backend])
    check = machine.check_opengl()
    assert (check.status, check.remedy) == (Status.FAILURE, "osmesa works here: export MUJOCO_GL=osmesa")
    assert "no EGL device" in check.detail
    answers["osmesa"] = {"error": "no libOSMesa"}
    assert "apt-get install" in machine.check_opengl().remedy
    answers["egl"] = {"renderer": "llvmpipe", "correct": False}
    assert "test picture is wrong" in machine.check_opengl().detail
    answers["egl"] = {"renderer": "llvmpipe", "correct": True}
    assert machine.check_opengl().status is Status.OK
    monkeypatch.setenv("MUJOCO_GL", "disable")
    assert machine.check_opengl().status is Status.FAILURE


@pytest.mark.slow
@pytest.mark.render
def test_the_test_render_runs_in_a_process_of_its_own():
    answer = probe.run_probe("doctor.probe_render", timeout_s=PATIENCE_S, environment={"MUJOCO_GL": "egl"})
    assert answer["correct"] is True


def test_a_probe_that_cannot_run_says_why():
    answer = probe.run_probe("no_such_probe", timeout_s=PATIENCE_S)
    assert "no_such_probe" in answer["error"]
    answer = probe.run_probe(
        "doctor.probe_render", timeout_s=PATIENCE_S, environment={"MUJOCO_GL": "nonsense"}
    )
    assert "nonsense" in answer["error"]


def test_the_hub_is_never_a_failure(monkeypatch):
    asked = []

    def refuse(url, timeout):
        asked.append(url)
        raise URLError("network is down")

    monkeypatch.setattr(sources.urllib.request, "urlopen", refuse)
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    assert sources.check_hub().status is Status.WARNING
    assert asked == []
    monkeypatch.delenv("HF_HUB_OFFLINE")
    monkeypatch.setenv("HF_ENDPOINT", "http://mirror.invalid/")
    check = sources.check_hub()
    assert check.status is Status.WARNING
    assert "network is down" in check.detail
    assert asked[0].startswith("http://mirror.invalid/api/")


def test_incomplete_libero_assets_say_what_is_missing(monkeypatch, tmp_path, installed):
    installed(**GOOD)
    monkeypatch.setenv("ROBORECOVER_LIBERO_ASSETS", str(tmp_path))
    (check,) = PLATFORM.examine(True, {})
    assert check.status is Status.FAILURE
    assert str(tmp_path) in check.remedy
    assert PLATFORM.examine(False, {})[0].status is Status.WARNING


def test_little_disk_is_a_warning(monkeypatch, tmp_path):
    assert machine.check_disk(tmp_path).detail.endswith(str(tmp_path))
    monkeypatch.setattr(machine.shutil, "disk_usage", lambda _: type("Usage", (), {"free": 1e9})())
    assert machine.check_disk(tmp_path).status is Status.WARNING


def test_gpu(monkeypatch):
    assert machine.check_gpu({"cuda": {"torch": "2.11", "devices": ["H200"]}}).status is Status.OK
    monkeypatch.setattr(machine, "_driver", lambda: "Some GPU")
    assert "Some GPU" in machine.check_gpu({"cuda": {"torch": "2.11", "devices": []}}).detail
    assert machine.check_gpu({"error": "no answer"}).status is Status.WARNING


CHECKS = [
    Check("Python", Status.OK, "3.12.1"),
    Check("Hub", Status.WARNING, "does not answer", "check the network"),
    Check("OpenGL", Status.FAILURE, "no device", "install " + "a-long-package-name " * 12),
]


def test_report_has_a_line_a_check_and_its_remedy():
    lines = format_report(CHECKS).splitlines()
    assert lines[0] == "ok       Python: 3.12.1"
    assert lines[2].strip() == "-> check the network"
    assert lines[-1] == "3 checks: 1 ok, 1 warnings, 1 failures"
    assert max(map(len, lines)) <= 110


def test_report_as_json():
    report = report_json(CHECKS)
    assert report["ok"] is False
    assert report_json(CHECKS[:2])["ok"] is True
    assert report["checks"][1] == {
        "name": "Hub",
        "status": "warning",
        "detail": "does not answer",
        "value": "does not answer",
        "expected": "",
        "remedy": "check the network",
    }


@pytest.mark.parametrize(("checks", "status"), [(CHECKS[:2], 0), (CHECKS, 1)])
def test_exit_status_and_json_output(monkeypatch, capsys, checks, status):
    monkeypatch.setattr(doctor, "examine", lambda platform: checks)
    assert cli.main(["doctor", "--json"]) == status
    assert json.loads(capsys.readouterr().out)["ok"] is (status == 0)
    assert cli.main(["doctor", "--platform", "metaworld"]) == status
    assert "ok       Python" in capsys.readouterr().out


def test_version_and_usage(capsys):
    with pytest.raises(SystemExit) as exit_:
        cli.main(["--version"])
    assert exit_.value.code == 0
    assert capsys.readouterr().out.startswith("roborecover 0.")
    with pytest.raises(SystemExit) as exit_:
        cli.main(["no-such-command"])
    assert exit_.value.code == 2


@pytest.mark.slow
def test_parsing_imports_neither_lerobot_nor_torch():
    code = (
        "import sys; from lerobot_roborecover.cli.main import build_parser; build_parser();"
        "sys.exit(bool({'torch', 'lerobot', 'mujoco'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


@pytest.mark.lerobot
@pytest.mark.nightly
def test_everything_on_this_machine_that_can_be_had_offline(monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    checks = {check.name: check for check in doctor.examine("metaworld")}
    assert checks["LeRobot plugin"].status is Status.OK
    assert {"Python", "OpenCV", "FFmpeg libraries", "OpenGL", "Hub", "GPU", "Cores", "Disk"} < set(checks)
    assert not any(check.failed for check in checks.values()), [c for c in checks.values() if c.failed]
