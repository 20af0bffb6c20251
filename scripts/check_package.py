"""Looks at a built sdist and wheel: one version, all package data, nothing else, and data below 12 MB."""

from __future__ import annotations

import ast
import sys
import tarfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = "lerobot_roborecover"
DATA_LIMIT_BYTES = 12_000_000
"""Of the shipped sets and the demo's policy, as they are packed in the wheel."""
CLONE_ONLY = "decisions.jsonl"
"""Of a set: which candidates were dropped, and why."""


def version() -> str:
    """The package's version, from its one place."""
    tree = ast.parse((ROOT / PACKAGE / "_version.py").read_text("utf-8"))
    for node in tree.body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__version__":
            return ast.literal_eval(node.value)
    sys.exit(f"{PACKAGE}/_version.py has no __version__")


def check(out: Path) -> list[str]:
    """What is wrong with the files of a folder, line by line.

    Args:
        out: holds one sdist and one wheel.
    """
    name = f"lerobot_env_roborecover-{version()}"
    wheel, sdist = out / f"{name}-py3-none-any.whl", out / f"{name}.tar.gz"
    problems = [
        f"{path} is missing; the version is {version()}" for path in (wheel, sdist) if not path.is_file()
    ]
    if problems:
        return problems
    with zipfile.ZipFile(wheel) as packed:
        infos = {info.filename: info for info in packed.infolist()}
    here = {
        str(path.relative_to(ROOT))
        for path in (ROOT / PACKAGE).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and path.name != CLONE_ONLY
    }
    inside = {name for name in infos if name.startswith(f"{PACKAGE}/")}
    problems += [f"the wheel lacks {name}" for name in sorted(here - inside)]
    problems += [f"the wheel has {name}, which the clone has not" for name in sorted(inside - here)]
    others = {name.split("/")[0] for name in infos} - {PACKAGE, "lerobot_env_roborecover.py"}
    problems += [f"the wheel has {name}" for name in sorted(others) if not name.endswith(".dist-info")]
    size = sum(info.compress_size for name, info in infos.items() if name.startswith(f"{PACKAGE}/data/"))
    if size >= DATA_LIMIT_BYTES:
        problems.append(
            f"data in the wheel: {size / 1e6:.1f} MB; the limit is {DATA_LIMIT_BYTES / 1e6:.0f} MB"
        )
    with tarfile.open(sdist) as packed:
        names = {Path(*Path(member.name).parts[1:]).as_posix() for member in packed.getmembers()}
    problems += [f"the sdist lacks {name}" for name in sorted((here | {"pyproject.toml", "LICENSE"}) - names)]
    print(f"{wheel.name}: {wheel.stat().st_size / 1e6:.1f} MB, of which data {size / 1e6:.1f} MB")
    print(f"{sdist.name}: {sdist.stat().st_size / 1e6:.1f} MB")
    return problems


if __name__ == "__main__":
    found = check(Path(sys.argv[1]))
    print(*found, sep="\n", end="\n" if found else "", file=sys.stderr)
    sys.exit(bool(found))
