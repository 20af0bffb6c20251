"""What `scripts/package.sh` refuses in a built package."""

from __future__ import annotations

import runpy
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NAMES = runpy.run_path(str(ROOT / "scripts" / "check_package.py"))


@pytest.fixture
def built(tmp_path):
    """A wheel and an sdist of empty files, with all that belongs into them."""
    name = f"lerobot_env_roborecover-{NAMES['version']()}"
    files = [
        str(path.relative_to(ROOT))
        for path in (ROOT / "lerobot_roborecover").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and path.name != "decisions.jsonl"
    ]
    wheel = tmp_path / f"{name}-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as packed:
        for file in (*files, "lerobot_env_roborecover.py", f"{name}.dist-info/METADATA"):
            packed.writestr(file, b"")
    with tarfile.open(tmp_path / f"{name}.tar.gz", "w:gz") as packed:
        for file in (*files, "pyproject.toml", "LICENSE"):
            packed.addfile(tarfile.TarInfo(f"{name}/{file}"))
    return wheel


def test_a_whole_package_passes(built):
    assert NAMES["check"](built.parent) == []


def test_what_should_not_be_there_or_is_too_large(built):
    with zipfile.ZipFile(built, "a") as packed:
        packed.writestr("tests/test_it.py", b"")
        packed.writestr("lerobot_roborecover/left_over.py", b"")
        packed.writestr("lerobot_roborecover/data/big.bin", bytes(12_000_000))
    found = "\n".join(NAMES["check"](built.parent))
    assert "the wheel has tests" in found
    assert "the wheel has lerobot_roborecover/left_over.py, which the clone has not" in found
    assert "data in the wheel: 12.0 MB; the limit is 12 MB" in found


def test_what_is_missing(built):
    built.unlink()
    assert "-py3-none-any.whl is missing" in NAMES["check"](built.parent)[0]
