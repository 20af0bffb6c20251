"""LIBERO's policies: which demonstrations each learns from, and their training.

    python -m recipes.libero.train --out libero
    python -m recipes.libero.train --out libero --only act_pixels --device cuda
    python -m recipes.libero.train --out libero --print

Each is trained by `lerobot-train` from `policies/train/libero/NAME.yaml`, one after the other, on
demonstrations that are made first. What is finished is skipped, what was interrupted goes on.
`libero/policies/NAME` are the results.
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from recipes.commands import program
from recipes.libero.demonstrations import part_of, tasks_of, write_dataset
from recipes.training import Training

EPISODES_PER_TASK = 16
"""Every second one is clean, the others are shaken."""
CONFIGS = Path("policies/train/libero")
POLICIES: dict[str, slice] = {
    "act": slice(None),
    "act_clean": slice(None, None, 2),
    "act_few": slice(4),
    "diffusion": slice(None),
    "tdmpc": slice(None),
    "act_pixels": slice(None),
    "act_recover": slice(None),
    "act_recover_large": slice(None),
    "tdmpc_recover": slice(None),
}
"""Which of each task's demonstrations a policy learns from, by its name."""
WITH_EYES = {"act_pixels": ("libero_spatial", "libero_object")}
"""Suites of the policies that see pictures."""
_SIDE = 64
WITH_RECOVERIES = dict.fromkeys(
    ("act_recover", "act_recover_large", "tdmpc_recover"), ("act_clean", "act_few")
)
"""After whom the expert takes over, in episodes that a policy also learns from."""
RECOVERIES_PER_TASK = 12


def episodes(name: str, parts: Path) -> list[int] | None:
    """The demonstrations a policy learns from, as `--dataset.episodes` wants them; None: all.

    Args:
        name: of the policy.
        parts: folder of the tasks' demonstrations, some of which may be fewer than others.
    """
    if POLICIES[name] == slice(None):
        return None
    numbers, first = [], 0
    for task in tasks_of(WITH_EYES.get(name)):
        count = len(np.load(part_of(parts, task))["lengths"])
        numbers += [first + n for n in range(count)[POLICIES[name]]]
        first += count
    return numbers


def training(name: str, out: Path, device: str = "cpu") -> Training:
    """A policy's training, in `out/train`."""
    kind = "pictures" if name in WITH_EYES else "demonstrations"
    dataset = out / ("with_recoveries" if name in WITH_RECOVERIES else kind)
    wanted = episodes(name, out / "demonstrations.parts")
    return Training(CONFIGS / f"{name}.yaml", dataset, out / "train" / name, wanted, device)


def make_demonstrations(out: Path, workers: int, pictures: bool) -> None:
    """Writes `out/demonstrations`, and `out/pictures` of the same.

    Args:
        out: folder to work in.
        workers: processes.
        pictures: whether somebody with eyes is to learn.

    Raises:
        subprocess.CalledProcessError: one failed; its own output says why.
    """
    maker = ["recipes.libero.demonstrations", f"--workers={workers}"]
    given = [f"--episodes-per-task={EPISODES_PER_TASK}", f"--parts={out / 'demonstrations.parts'}"]
    suites = sorted({suite for found in WITH_EYES.values() for suite in found})
    wanted = {"demonstrations": []} | (
        {"pictures": [f"--pictures={_SIDE}", "--suites", *suites]} if pictures else {}
    )
    for name, more in wanted.items():
        if not (out / name).exists():
            program(*maker, *given, f"--out={out / name}", *more)


def make_recoveries(out: Path, after: Sequence[str], workers: int) -> None:
    """Writes `out/recoveries`, and with the demonstrations `out/with_recoveries`.

    Args:
        out: folder to work in.
        after: names of policies of the clone (`policies/libero`).
        workers: processes.

    Raises:
        subprocess.CalledProcessError: one failed; its own output says why.
    """
    if (out / "with_recoveries").exists():
        return
    if not (out / "recoveries").exists():
        program(
            "recipes.libero.demonstrations", f"--workers={workers}",
            f"--episodes-per-task={RECOVERIES_PER_TASK}", f"--out={out / 'recoveries'}",
            "--after", *(f"policies/libero/{name}" for name in after),
        )  # fmt: skip
    parts = [
        (task, part)
        for folder in ("demonstrations.parts", "recoveries.parts")
        for task in tasks_of(None)
        if len(np.load(part := part_of(out / folder, task))["lengths"])
    ]
    write_dataset(out / "with_recoveries", parts)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder to work in")
    parser.add_argument("--only", nargs="+", choices=POLICIES, default=list(POLICIES), metavar="NAME")
    parser.add_argument("--device", default="cpu", help="cpu, or cuda")
    parser.add_argument("--workers", type=int, default=2, help="processes that make demonstrations")
    parser.add_argument("--print", action="store_true", help="print the training commands and train nothing")
    args = parser.parse_args()
    if not CONFIGS.is_dir():
        parser.error(f"{CONFIGS} is not here: run this in the top folder of a checkout of the repository")
    args.out.mkdir(parents=True, exist_ok=True)
    make_demonstrations(args.out, args.workers, pictures=any(name in WITH_EYES for name in args.only))
    for name in args.only:
        if name in WITH_RECOVERIES and not args.print:
            make_recoveries(args.out, WITH_RECOVERIES[name], args.workers)
        wanted, result = training(name, args.out, args.device), args.out / "policies" / name
        if args.print:
            print(shlex.join(["lerobot-train", *wanted.arguments()]))
        elif not result.exists():
            wanted.run(result)


if __name__ == "__main__":
    main()
