"""The whole chain from one file: collect, join, annotate, agree, screen, validate, split, render,
publish.

Each stage makes a folder of its own below `out`; `stages.jsonl` records what each finished stage was made
from. A stage whose options and inputs are unchanged is not run again. One that has changed, or whose result
is gone, has its old result moved to `old/` first, and everything after it is made anew. What takes long
(rollouts, votes, trials, replays) is kept beside the results and goes on where it was.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from lerobot_roborecover.curation.candidates import CANDIDATES_FILE, STEPS_FILE, read_candidates
from lerobot_roborecover.curation.candidates_write import merge_candidates
from lerobot_roborecover.curation.funnel import read_decisions
from lerobot_roborecover.curation.pipeline import requests
from lerobot_roborecover.curation.pipeline.config import OLD_KEYS, BuildPaths, ChainConfig
from lerobot_roborecover.curation.pipeline.work import StageRunners
from lerobot_roborecover.curation.resolution import queued, resolve, write_discussion
from lerobot_roborecover.datasets.schema import FOLDER
from lerobot_roborecover.datasets.write import file_sha256
from lerobot_roborecover.errors import OptionError, RoboRecoverError
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_dir
from lerobot_roborecover.utils.journal import Journal, read_journal
from lerobot_roborecover.utils.text import format_duration, next_command, pluralize

STAGES = ("collect", "join", "annotate", "agree", "screen", "validate", "split", "render", "publish")
JOURNAL_FILE = "stages.jsonl"
_SCHEMA = 1
_PACE = ("engine", "ray_address", "replicas", "num_workers", "limit_s", "watchdog", "retry_errors")
"""Options that decide how fast a result comes, not what it is."""
_ADDED = {"early_stop", "give_up_after", "min_distance", "min_per_split", "no_scarce", "repeat", "unscreened"}
"""Options that earlier versions did not have: where they are not given, what those built is up to date."""


class AwaitingAnnotations(Exception):
    """A stage waits for people; the message says for what, and how to go on."""


@dataclass
class PipelineStage:
    """One step of the chain."""

    name: str
    """Of `STAGES`."""
    label: str
    """The same, and which of several."""
    out: Path | None
    """What it makes; None where that lies elsewhere (votes, the Hub)."""
    identity: Any
    """Options and inputs of its own, JSON-able; the stages before count on top."""
    work: Callable[[], None]
    complete: bool = True
    """False where there is something to do although nothing has changed: votes are missing."""


class BuildEta:
    """Says how far a build is.

    Args:
        labels: of all stages, in order.
        seconds: that a stage took when it last ran, by label.
    """

    def __init__(self, labels: Sequence[str], seconds: Mapping[str, float]):
        self._labels, self._seconds, self._began = labels, seconds, time.monotonic()

    def at(self, label: str) -> str:
        """Which stage of how many this is, the time since the build began, and what is left as far as earlier
        runs tell."""
        number = self._labels.index(label)
        left = [self._seconds.get(later) for later in self._labels[number:]]
        known = sum(s for s in left if s is not None)
        unknown = sum(s is None for s in left)
        words = f"about {format_duration(known)}" if unknown < len(left) else "not known yet"
        if 0 < unknown < len(left):
            words += f" and {pluralize(unknown, 'stage')} never timed"
        elapsed = format_duration(time.monotonic() - self._began)
        return f"[stage {number + 1} of {len(self._labels)}, {elapsed} elapsed, left at most: {words}]"


@dataclass
class Pipeline:
    """A build.

    Args:
        config: what.
        work: the stages' functions.
        say: takes lines for people.
    """

    config: ChainConfig
    work: StageRunners
    say: Callable[[str], None] = print
    places: BuildPaths = field(init=False)

    def __post_init__(self):
        self.places = BuildPaths(self.config)

    def build(self, first: str = "", until: str = "", dry_run: bool = False) -> list[dict[str, Any]]:
        """Runs what is not up to date.

        Args:
            first: run this stage and all after it in any case.
            until: stop after this stage.
            dry_run: only say what would run.

        Returns:
            Each stage that was looked at: its name, whether it ran, and seconds.

        Raises:
            Waiting: people have to do something first.
            OptionError, ScenarioError: a stage cannot run.
        """
        for option, name in (("--from", first), ("--until", until)):
            if name and name not in STAGES:
                raise OptionError(f"{option} {name}: not one of {', '.join(STAGES)}")
        if first and until and STAGES.index(first) > STAGES.index(until):
            raise OptionError(
                f"--from {first} --until {until}: the stages come in the order {', '.join(STAGES)}"
            )
        done = []
        path = self.places.root / JOURNAL_FILE
        with nullcontext() if dry_run else Journal(path, _SCHEMA) as journal:
            records = read_journal(path, _SCHEMA)
            known = {r["label"]: r["key"] for r in records}
            pace = BuildEta(self.labels(until), {r["label"]: r["seconds"] for r in records})
            key, anew = "", False
            for stage in self._stages():
                if until and STAGES.index(stage.name) > STAGES.index(until):
                    break
                before = key
                key = _key(before, stage)
                forced = anew or (bool(first) and STAGES.index(stage.name) >= STAGES.index(first))
                there = stage.out is None or stage.out.exists()
                fresh = known.get(stage.label) == key and there and stage.complete and not forced
                what = "up to date" if fresh else "would run" if dry_run else "runs"
                self.say(f"{pace.at(stage.label)} {stage.label}: {what}")
                # The same key need not be the same result: trials that were kept, or the version, are others.
                # What comes before `agree` is hashed for the stage after it.
                anew = anew or (not fresh and STAGES.index(stage.name) >= STAGES.index("agree"))
                seconds = 0.0
                if not fresh and journal is not None:
                    began = time.monotonic()
                    # A stage that was killed may have its result, but no record. `collect` knows its own;
                    # what the others make is made anew, from what they keep beside it.
                    if stage.name != "collect" or stage.label in known:
                        self._set_aside(stage.out)
                    self._run(stage)
                    seconds = time.monotonic() - began
                    at = datetime.now(UTC).isoformat(timespec="seconds")
                    note = {"label": stage.label, "key": key, "seconds": round(seconds, 1), "at": at}
                    journal.append(note)
                done.append({"stage": stage.label, "ran": not fresh and not dry_run, "seconds": seconds})
        return done

    def labels(self, until: str = "") -> list[str]:
        """Every stage's label, in order, up to the last one that is asked for."""
        config = self.config
        before = STAGES.index(until) + 1 if until else len(STAGES)
        found = {name: [name] for name in STAGES}
        found["collect"] = [f"collect {name}" for name, part in config.collect.items() if not part.dataset]
        found["render"] *= config.render is not None
        found["publish"] *= config.publish is not None
        return [label for name in STAGES[:before] for label in found[name]]

    def _stages(self) -> Iterator[PipelineStage]:
        """The stages in order; each is asked for its inputs only when its turn has come."""
        config, places, work = self.config, self.places, self.work
        for name, part in config.collect.items():
            if part.dataset:
                self._existing(name, Path(part.dataset))
                continue
            out = places.collected(name)
            options = requests.collect_options(config, name, part, out)
            yield PipelineStage(
                "collect",
                f"collect {name}",
                out,
                _options(part),
                lambda options=options: work.collect(options, self.say),
            )
        inputs = [Path(p.dataset) if p.dataset else places.collected(n) for n, p in config.collect.items()]
        yield PipelineStage(
            "join", "join", places.candidates, [_identity(p) for p in inputs], lambda: self._join(inputs)
        )
        yield PipelineStage("annotate", "annotate", None, None, self._annotate, not self._open())
        votes = {p.name: file_sha256(p) for p in sorted(places.votes.glob("*.jsonl"))}
        yield PipelineStage(
            "agree",
            "agree",
            places.scenarios,
            [_options(config.annotate), votes, config.license],
            lambda: work.agree(requests.agree_request(config, places), self.say),
        )
        yield PipelineStage(
            "screen",
            "screen",
            places.screened,
            _options(config.screen),
            lambda: work.screen(requests.screen_request(config, places), self.say),
        )
        rejects = Path(config.validate.rejects) if config.validate.rejects else None
        people = Path(f"{places.validated}.replays") / "rejects.jsonl"
        # `validate` itself leaves an empty record of rejections behind.
        looked = [file_sha256(p) for p in (rejects, people) if p and p.is_file() and p.stat().st_size]
        yield PipelineStage(
            "validate",
            "validate",
            places.validated,
            [_options(config.validate), looked],
            lambda: work.validate(requests.validation_request(config, places), self.say),
        )
        yield PipelineStage(
            "split",
            "split",
            places.split,
            _options(config.split),
            lambda: work.split(places.validated, requests.split_config(config), places.split, self.say),
        )
        if config.render is not None:
            yield PipelineStage(
                "render",
                "render",
                places.rendered,
                _options(config.render),
                lambda: work.render(requests.render_request(config, places), self.say),
            )
        if (publish := config.publish) is not None:
            yield PipelineStage(
                "publish",
                "publish",
                None,
                _options(publish),
                lambda: work.publish(requests.publish_request(publish, places), self.say),
            )

    def _run(self, stage: PipelineStage) -> None:
        """Runs a stage.

        Raises:
            Waiting: people have to do something first.
            ScenarioError: it cannot run; says which it is, and how to go on.
        """
        try:
            stage.work()
        except RoboRecoverError as err:
            raise ScenarioError(f"{stage.label}: {err}. What had finished is kept: run build again") from err

    def _set_aside(self, out: Path | None) -> None:
        """Moves an earlier result out of the way; nothing is deleted."""
        if out is None or not out.exists():
            return
        self.places.old.mkdir(parents=True, exist_ok=True)
        number = 1
        while (there := self.places.old / f"{out.name}-{number}").exists():
            number += 1
        os.replace(out, there)
        self.say(f"the earlier {out} is now {there}")

    def _existing(self, name: str, dataset: Path) -> None:
        found = read_candidates(dataset)
        if found.platform != self.config.platform:
            raise ScenarioError(
                f"collect.{name}: {dataset} is of {found.platform}, this build of {self.config.platform}"
            )

    def _join(self, inputs: list[Path]) -> None:
        missing = [str(path) for path in inputs if not path.exists()]
        if missing:
            self.say(f"nothing was collected in {', '.join(missing)}")
        present = [path for path in inputs if path.exists()]
        if not present:
            raise ScenarioError("nothing was collected at all; see the tables above")
        with atomic_dir(self.places.candidates) as folder:
            merge_candidates(folder, present)
        total = len(read_candidates(self.places.candidates))
        joined = f"{pluralize(total, 'candidate')} of {pluralize(len(present), 'dataset')}"
        self.say(f"{joined} in {self.places.candidates}")

    def _open(self) -> dict[str, int]:
        """Candidates that are not settled, by why."""
        if not self.places.candidates.exists():
            return {"waiting": 1}
        candidates = read_candidates(self.places.candidates)
        if not any(p.stat().st_size for p in self.places.votes.glob("*.jsonl")):
            return {"waiting": len(queued(candidates))}
        found = resolve(candidates, self.places.votes, requests.resolution_config(self.config))
        counts = found.counts()
        names = ["waiting"] + (["no consensus"] if self.config.annotate.no_consensus == "discuss" else [])
        if counts.get("no consensus") and "no consensus" in names:
            write_discussion(self.places.discuss, found)
        return {name: counts[name] for name in names if counts.get(name)}

    def _annotate(self) -> None:
        waiting = self._open()
        if waiting.get("waiting") and self.config.annotate.automatic:
            self.work.annotate(self.places.candidates, self.places.votes, self.say)
            waiting = self._open()
        if not waiting:
            return
        base = ["curate", "annotate", str(self.places.candidates), "--votes", str(self.places.votes)]
        base += ["--annotator", "NAME"]
        if waiting.get("waiting"):
            several = waiting["waiting"] != 1
            raise AwaitingAnnotations(
                f"{pluralize(waiting['waiting'], 'candidate')} {'wait' if several else 'waits'} for votes "
                f"({self.config.annotate.votes_needed} each). Annotate (--annotator may be given again), "
                f"then run build again\n{next_command(base)}"
            )
        several = waiting["no consensus"] != 1
        raise AwaitingAnnotations(
            f"{pluralize(waiting['no consensus'], 'candidate')} {'are' if several else 'is'} without "
            "consensus. Discuss, then run build again; or set annotate.no_consensus: drop\n"
            + next_command([*base, "--only", str(self.places.discuss)])
        )


def _options(part: Any) -> Any:
    """What of a part decides a result; checkpoints by their content."""
    from lerobot_roborecover.policies.identity import policy_identity

    given = asdict(part).items()
    stored = {new: old for old, new in OLD_KEYS.items()}  # names in the records of earlier builds
    found = {stored.get(k, k): v for k, v in given if k not in _PACE and not (k in _ADDED and v is None)}
    if found.get("policy"):
        found["policy"] = policy_identity(found["policy"])
    for policy in found.get("policies", ()):
        policy["path"] = policy_identity(policy["path"])
    return found


def _identity(dataset: Path) -> Any:
    """What a candidate dataset is, without reading its videos; decisions of its collection included, since
    people may take those back."""
    folder = dataset / FOLDER
    if not dataset.exists():
        return None
    decisions = [dataclasses.astuple(d) for d in read_decisions(dataset) if d.stage == "collect"]
    return [[file_sha256(folder / n) for n in (CANDIDATES_FILE, STEPS_FILE)], decisions]


def _key(before: str, stage: PipelineStage) -> str:
    text = json.dumps([before, stage.label, stage.identity], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()
