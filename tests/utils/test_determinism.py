"""Simulators round alike on every processor that can (`lerobot_roborecover/utils/determinism.py`)."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from lerobot_roborecover.utils.determinism import CORE_TYPE, KERNELS, VARIABLE, has_kernels, policy_kernels
from tests.support.shipped_policies import CHECKPOINT

needs_kernels = pytest.mark.skipif(not has_kernels(), reason="no AVX2 in this processor: nothing to do")
CODE = "from lerobot_roborecover.utils.determinism import core_type_in_use; print(core_type_in_use())"


def core_type(code: str = CODE, **environment: str) -> str:
    clean = {k: v for k, v in os.environ.items() if k != VARIABLE}
    done = subprocess.run(
        [sys.executable, "-c", code], env={**clean, **environment}, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


@needs_kernels
def test_the_package_chooses_the_kernels():
    assert core_type() == CORE_TYPE


@needs_kernels
def test_the_user_comes_first():
    assert core_type(**{VARIABLE: "Sandybridge"}) == "Sandybridge"


@needs_kernels
def test_workers_inherit_them_even_if_numpy_was_there_before():
    code = f"import numpy, os; import lerobot_roborecover; print(os.environ['{VARIABLE}'])"
    assert core_type(code) == CORE_TYPE


@pytest.mark.parametrize(
    ("flags", "found"), [("fpu avx avx2 fma", True), ("fpu avx fma", False), ("fpu avx2", False), ("", False)]
)
def test_kernels_that_would_crash_the_processor_are_not_chosen(tmp_path, monkeypatch, flags, found):
    monkeypatch.setattr("platform.machine", lambda: "x86_64")
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text(f"processor\t: 0\nflags\t\t: {flags}\n")
    assert has_kernels(cpuinfo) is found
    assert not has_kernels(tmp_path / "missing")
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    assert not has_kernels(cpuinfo)


@pytest.mark.parametrize("can", [True, False])
def test_a_policy_gets_kernels_that_its_processor_has(monkeypatch, can):
    monkeypatch.setattr("lerobot_roborecover.utils.determinism.has_kernels", lambda: can)
    assert policy_kernels() == (dict(KERNELS) if can else {"OMP_NUM_THREADS": "1"})


def test_the_shipped_study_names_them():
    from recipes.study.definition import read_definition, shipped_study

    assert read_definition(shipped_study()).environment == KERNELS


@needs_kernels
@pytest.mark.lerobot
def test_square_roots_in_float64_round_to_the_float32_that_is_right():
    """Those in float32 do not, with any kernels: a noise schedule has to be in float64."""
    code = (
        "import numpy as np, torch; x = np.random.default_rng(0).random(1 << 16).astype('f4');"
        "roots = torch.sqrt(torch.from_numpy(x).double()).float().numpy();"
        "print(int((roots != np.sqrt(x)).sum()))"
    )
    assert core_type(code, **KERNELS) == "0"


@pytest.mark.slow
@pytest.mark.parametrize(
    "words", [["build", "missing.yaml"], ["screen", "missing", "--policy", CHECKPOINT, "--out", "out"]]
)
def test_commands_whose_outcomes_are_stored_choose_a_policys_kernels(words, tmp_path):
    """Before torch is loaded; what the user has chosen stays."""
    program = (
        "import os, sys\n"
        "from lerobot_roborecover.cli.main import main\n"
        "from lerobot_roborecover.utils.determinism import KERNELS\n"
        "status = main(sys.argv[1:])\n"
        "print(status, *(os.environ.get(name, '-') for name in KERNELS))"
    )
    env = {k: v for k, v in os.environ.items() if k not in KERNELS} | {"OMP_NUM_THREADS": "3"}
    done = subprocess.run(
        [sys.executable, "-c", program, *words],
        capture_output=True, text=True, env=env, cwd=tmp_path, check=True,
    )  # fmt: skip
    chosen = {**policy_kernels(), "OMP_NUM_THREADS": "3"}
    assert done.stdout.split() == ["2", *(chosen.get(name, "-") for name in KERNELS)]
