"""Which correction data helps most a minute: the recovery rate on natural failures against minutes of it.

    python -m recipes.recovery_per_hour --platform metaworld --out outputs/recovery_per_hour
    python -m recipes.recovery_per_hour --platform libero --out outputs/recovery_per_hour_libero
    python -m recipes.recovery_per_hour --platform metaworld --out outputs/stored --use-stored-outcomes

A base policy is trained on for as many steps with its own demonstrations and, as often, with corrections:
none, or 5, 15 or 45 minutes of them as the robot moves. They are other policies' recoveries from the training
scenarios (`donors`), a scripted operator's who takes over at a drawn step of a clean rollout (`takeover`), or
the same operator's at steps of trials in which the base fails (`forks`). Every policy runs from the recovery
points and first states of the natural test scenarios. What is finished is skipped.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np

from lerobot_roborecover.analysis.figures.style import LINE, colour, dash, drawing, marker, svg_of
from lerobot_roborecover.curation.split import start_of
from lerobot_roborecover.datasets import load_scenarios
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.platforms import make_simulator, platform_named
from lerobot_roborecover.scenario import Source, Start
from recipes.commands import evaluate, roborecover
from recipes.corrections import forks
from recipes.episodes import Episode, draw, frames_of, read_episodes, write_episodes
from recipes.outcomes import OUTCOMES, method_rates, store_logs, stored_logs
from recipes.training import Training

SOURCES = ("donors", "takeover", "forks")
MINUTES = (5, 15, 45)
SEEDS = (0, 1, 2, 3)
"""Of training, and of which corrections are drawn: four runs are the fewest that a verdict is given on."""
NONE = "none"
ARMS = (NONE, *(f"{source}_{minutes}" for source in SOURCES for minutes in MINUTES))
FIRST_LOOK = (NONE, *(f"{source}_{MINUTES[-1]}" for source in SOURCES))
"""What the primary question compares."""


@dataclass(frozen=True)
class Subject:
    """A base policy, its platform, and where its corrections come from."""

    scenarios: str
    base: Path
    """Deterministic: a trial of it is run once."""
    donors: Mapping[str, int]
    """Policies beside the base, and their trials of each training scenario."""
    robot: str
    stride: int
    """Between the forks of a trial, control steps."""
    last: int
    """Fork of a trial, at most."""

    @property
    def platform(self) -> str:
        return self.scenarios.partition("_")[0]

    @property
    def recipes(self) -> ModuleType:
        """Of the platform: `demonstrations`, `takeovers`, `correction`."""
        return import_module(f"recipes.{self.platform}.corrections")

    def frames(self, minutes: float) -> int:
        """As many as the robot has steps in so many minutes."""
        return round(minutes * 60 * platform_named(self.platform).control_hz)


SUBJECTS = {
    "metaworld": Subject(
        "metaworld_recovery", Path("policies/study/metaworld_study/policies/act"),
        {"act_clean": 1, "act_few": 1, "tdmpc": 1, "diffusion": 3, "diffusion_few": 3}, "sawyer", 10, 200,
    ),
    "libero": Subject(
        "libero_recovery", Path("policies/libero/act_few"),
        {"act": 1, "act_clean": 1, "act_recover": 1}, "panda", 60, 180,
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Study:
    """One platform's runs, all in one folder."""

    subject: Subject
    out: Path

    def demonstrations(self) -> list[Episode]:
        """The base's own."""
        return self.subject.recipes.demonstrations(self.out, self.subject.base.name)

    def trials(
        self, policy: Path, split: str, folder: Path, *, start: str = "recovery", trials: int = 1
    ) -> Path:
        """Log of a policy's trials; of the tests those that are a learned policy's own failures."""
        subject = self.subject
        # All runs share the snapshots of recovery points.
        options = [f"--policy.path={policy}", f"--env.snapshot_dir={self.out / 'snapshots'}"]
        if split == "test":
            options.append(f"--env.select=source={Source.NATURAL.value}")
        return evaluate(
            subject.platform, subject.scenarios, split, folder, *options, start=start, trials=trials
        )

    def corrections(self, source: str) -> list[Episode]:
        """All of a source, made if they are not there."""
        made: Callable[[], Iterator[Episode] | None] = getattr(self, f"_{source}")
        root = self.out / "corrections" / source
        if not root.exists():
            episodes = made()
            if episodes is not None:
                self._write(root, episodes)
        return read_episodes(root)

    def _write(self, root: Path, episodes: Iterable[Episode]) -> None:
        fps = int(platform_named(self.subject.platform).control_hz)
        write_episodes(root, episodes, fps, self.subject.robot)

    def _donors(self) -> None:
        subject = self.subject
        logs = [
            self.trials(subject.base.with_name(name), "train", self.out / "donors" / name, trials=trials)
            for name, trials in subject.donors.items()
        ]
        roborecover(
            "curate", "training-data", *logs, "--scenarios", subject.scenarios, "--split", "train",
            "--env", "obs_type=state", "--outcome", "successes", "--out", self.out / "corrections" / "donors",
        )  # fmt: skip

    @property
    def _enough(self) -> float:
        """Frames of a source: a tenth more than what is drawn at most, for a task may have fewer."""
        return 1.1 * self.subject.frames(MINUTES[-1])

    def _takeover(self) -> Iterator[Episode]:
        scenarios = load_scenarios(self.subject.scenarios, split="train")
        tasks = {(s.task.suite, s.task.name): s.task for s in scenarios}
        each = round(self._enough / len(tasks))
        return self.subject.recipes.takeovers(
            self.subject.base, [tasks[name] for name in sorted(tasks)], each
        )

    def _forks(self) -> Iterator[Episode]:
        scenarios = {s.id: s for s in load_scenarios(self.subject.scenarios, split="train")}
        failures, begun = [], set()
        for start in (Start.RECOVERY, Start.INITIAL):
            log = self.trials(self.subject.base, "train", self.out / "base" / start, start=start)
            for row in read_trial_log(log):
                scenario = scenarios[row.scenario_id]
                begins = start_of(scenario) if start is Start.INITIAL else row.scenario_id
                if not row.success and begins not in begun:  # scenarios that share a first state: once
                    begun.add(begins)
                    failures.append((scenario, start))
        print(f"the base fails in {len(failures)} trials of the training scenarios", flush=True)
        subject, order = self.subject, np.random.default_rng(0).permutation(len(failures))
        simulator = make_simulator(subject.platform, obs_type="state")
        made = forks(
            simulator, subject.recipes.correction, subject.base, [failures[n] for n in order],
            subject.stride, subject.last,
        )  # fmt: skip
        return until(made, self._enough)

    def dataset(self, arm: str, seed: int) -> Path:
        """What an arm is trained on: demonstrations and corrections, each as many frames."""
        source, _, minutes = arm.partition("_")
        root = self.out / "data" / (arm if arm == NONE else f"{arm}_{seed}")
        if root.exists():
            return root
        episodes = self.demonstrations()
        if arm != NONE:
            available = self.corrections(source)
            wanted = self.subject.frames(float(minutes))
            if (there := frames_of(available)) < wanted:
                print(f"{arm}: {there} frames are there, fewer than the {wanted} wanted", flush=True)
            corrections = list(draw(available, min(wanted, there), seed))
            half = max(frames_of(episodes), frames_of(corrections))
            episodes = [*repeated(episodes, half), *repeated(corrections, half)]
        self._write(root, episodes)
        return root

    def policy(self, arm: str, seed: int, options: Sequence[str] = ()) -> Path:
        """An arm's policy of a seed, trained if it is not there."""
        result = self.out / "policies" / f"{arm}_{seed}"
        if not result.exists():
            Training(
                Path(f"policies/train/recovery_per_hour_{self.subject.platform}.yaml"),
                self.dataset(arm, seed), self.out / "train" / result.name,
                options=(f"--seed={seed}", *options),
            ).run(result)  # fmt: skip
        return result

    def result(self, arm: str, seed: int, options: Sequence[str] = ()) -> Path:
        """An arm's trial log of a seed, from both starts."""
        policy = self.policy(arm, seed, options)
        for start in Start.RECOVERY, Start.INITIAL:
            log = self.trials(policy, "test", self.out / "results" / policy.name, start=start)
        return log


def repeated(episodes: Sequence[Episode], frames: int) -> Iterator[Episode]:
    """Episodes in turn, again and again, to exactly so many frames; the last one is cut."""
    for episode in itertools.cycle(episodes):
        if frames <= 0:
            return
        kept = episode.cut(frames)
        frames -= len(kept)
        yield kept


def until(episodes: Iterable[Episode], frames: float) -> Iterator[Episode]:
    """Episodes until there are so many frames, the last one whole."""
    made = 0
    for episode in episodes:
        yield episode
        made += len(episode)
        if made >= frames:
            return


def report(logs: Mapping[str, Path], out: Path) -> None:
    """Reports on the primary question and on all arms; draws the curve.

    Args:
        logs: trial logs by run, `ARM_SEED`.
        out: folder to work in.
    """
    for name, arms in (("primary", FIRST_LOOK), ("all", ARMS)):
        named = [
            f"{arm}={','.join(runs)}"
            for arm in arms
            if (runs := [str(log) for run, log in logs.items() if run.rpartition("_")[0] == arm])
        ]
        if named:
            roborecover("report", *named, "--out", out / "report" / name)
    if len(logs) > len(ARMS):
        print(f"curve     {draw_curve(out / 'report' / 'all')}")


def draw_curve(folder: Path) -> Path:
    """The rates against minutes of correction data, from a report's own tables, as an SVG.

    Raises:
        OSError, KeyError: there is no report, or none of methods of several runs.
    """
    rates = method_rates(folder)
    with drawing() as subplots:
        plot, axes = subplots(6.4, 3.6)
        for i, source in enumerate(SOURCES):
            arms = [NONE, *(f"{source}_{minutes}" for minutes in MINUTES)]
            for k, values in enumerate(rates):
                label = ("recovery points", "initial states")[k]
                shown = [(place, values[arm]) for place, arm in enumerate(arms) if arm in values]
                places = [place + 0.06 * (i - 1) for place, _ in shown]
                middle = [100 * value["value"] for _, value in shown]
                below = [100 * (value["value"] - value["low"]) for _, value in shown]
                above = [100 * (value["high"] - value["value"]) for _, value in shown]
                axes.errorbar(
                    places, middle, [below, above], color=colour(i), marker=marker(i), ms=5, lw=1.4,
                    capsize=3, ls=dash(k), label=f"{source}, {label}",
                )  # fmt: skip
        axes.set_xticks(range(len(MINUTES) + 1), ["0", *map(str, MINUTES)])
        axes.set_xlabel("minutes of correction data")
        axes.set_ylabel("success, %")
        axes.set_ylim(0, 100)
        axes.grid(color=LINE, lw=0.6)
        axes.legend(loc="lower left", fontsize=7, handlelength=4)
        path = folder / "recovery_per_hour.svg"
        path.write_bytes(svg_of(plot))
    return path


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--platform", choices=SUBJECTS, default="metaworld", help="(%(default)s)")
    add("--out", type=Path, required=True, help="folder to work in; a rerun goes on there")
    add("--only", nargs="+", choices=ARMS, default=list(ARMS), metavar="ARM")
    add("--seeds", nargs="+", type=int, default=list(SEEDS))
    add("--store", action="store_true", help="keep the outcomes with the code")
    add("--use-stored-outcomes", action="store_true", help="run nothing: report those kept with the code")
    add("--train-option", nargs="+", default=[], metavar="OPTION", help="of lerobot-train, without dashes")
    args = parser.parse_args()
    subject = SUBJECTS[args.platform]
    stored = OUTCOMES / f"recovery_per_hour_{args.platform}"
    if args.use_stored_outcomes:
        report(stored_logs(stored), args.out)
        return
    if not subject.base.is_dir():
        parser.error(
            f"{subject.base} is not here: run this in the top folder of a checkout of the repository"
        )
    args.out.mkdir(parents=True, exist_ok=True)
    study = Study(subject, args.out)
    options = [f"--{option}" for option in args.train_option]
    # All arms with one seed before the next one: what there is can be compared.
    logs = {f"{arm}_{seed}": study.result(arm, seed, options) for seed in args.seeds for arm in args.only}
    if args.store:
        store_logs(logs, stored)
    report(logs, args.out)


if __name__ == "__main__":
    main()
