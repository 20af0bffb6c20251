"""What importing costs, and what stays out of simulator workers."""

from __future__ import annotations

import subprocess
import sys

import pytest

HEAVY = ("lerobot", "torch", "mujoco", "metaworld", "libero", "robosuite", "datasets", "huggingface_hub")


def modules_after(code: str) -> set[str]:
    out = subprocess.run(
        [sys.executable, "-c", f"{code}\nimport sys; print(' '.join(sys.modules))"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return {name.partition(".")[0] for name in out.stdout.split()}


def test_importing_the_package_is_light():
    loaded = modules_after("import lerobot_roborecover")
    assert not loaded & {*HEAVY, "pyarrow", "matplotlib", "scipy", "numpy", "gymnasium"}


def test_public_names_are_listed():
    import lerobot_roborecover

    assert set(lerobot_roborecover.__all__) <= set(dir(lerobot_roborecover))
    assert all(getattr(lerobot_roborecover, name) for name in ("load_scenarios", "TrialRow", "report"))


def test_help_is_light():
    """It costs a tenth of a second, most of it Python's own."""
    code = (
        "from lerobot_roborecover.cli.main import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    print()"
    )
    assert not modules_after(code) & {
        *HEAVY,
        "pyarrow",
        "matplotlib",
        "scipy",
        "numpy",
        "gymnasium",
        "jinja2",
    }


@pytest.mark.parametrize(
    "code",
    [
        "import lerobot_roborecover, gymnasium",
        "import gymnasium, lerobot_roborecover",
        "import importlib.util, lerobot_roborecover; importlib.util.find_spec('gymnasium'); import gymnasium",
        # Gymnasium's import begins in the middle of these.
        *(
            f"import lerobot_roborecover.{name}, gymnasium"
            for name in ("platforms", "platforms.lerobot", "platforms.fake.simulator", "workers.recovery_env")
        ),
    ],
)
def test_gymnasium_knows_the_ids_in_any_order_of_imports(code):
    check = (
        f"{code}\nassert 'roborecover/Lerobot_pusht-v0' in gymnasium.registry"
        "\nimport inspect, sys; assert inspect.getsource(gymnasium)"
        "\nassert not [f for f in sys.meta_path if 'roborecover.' in type(f).__module__], 'no finder is left'"
    )
    done = subprocess.run([sys.executable, "-W", "error", "-c", check], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("first", ["import lerobot_roborecover; ", ""])
def test_gymnasium_makes_an_environment_by_module_and_id(first):
    code = (
        f"{first}import gymnasium\n"
        "from tests.support.factories import fake_scenario\n"
        "env = gymnasium.make('lerobot_roborecover:roborecover/Fake-v0', scenario=fake_scenario(0))\n"
        "env.reset()"
    )
    assert modules_after(code)


def test_a_worker_needs_neither_lerobot_nor_torch():
    code = (
        "from lerobot_roborecover.workers import jobs, worker\n"
        "from lerobot_roborecover.workers.messages import SlotConfig\n"
        "worker.SlotServer(SlotConfig('fake'))"
    )
    assert not modules_after(code) & set(HEAVY)


@pytest.mark.slow
def test_a_running_metaworld_worker_loads_neither_lerobot_nor_torch():
    code = (
        "from lerobot_roborecover.workers.worker import SlotServer\n"
        "from lerobot_roborecover.workers.messages import EpisodeSpec, SlotConfig\n"
        "from lerobot_roborecover import load_scenarios\n"
        "server = SlotServer(SlotConfig('metaworld', {'obs_type': 'state'}))\n"
        "server.answer('reset', EpisodeSpec(load_scenarios('metaworld_starter')[0], 'recovery', 0, True))"
    )
    assert not modules_after(code) & {"lerobot", "torch"}


def test_reading_scenarios_needs_no_simulator():
    assert not modules_after("from lerobot_roborecover import load_scenarios") & {
        "lerobot",
        "torch",
        "mujoco",
    }


def test_the_version_has_one_place():
    import tomllib
    from pathlib import Path

    import yaml

    from lerobot_roborecover import __version__

    root = Path(__file__).parents[1]
    project = tomllib.loads((root / "pyproject.toml").read_text())
    assert "version" not in project["project"]
    assert project["tool"]["setuptools"]["dynamic"]["version"] == {
        "attr": "lerobot_roborecover._version.__version__"
    }
    assert yaml.safe_load((root / "CITATION.cff").read_text())["version"] == __version__
