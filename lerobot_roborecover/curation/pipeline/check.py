"""Everything of a build that can be refused, before its first stage runs.

A build takes hours, and its last stage should not be the one to find that a number was mistyped. All problems
are reported together.
"""

from __future__ import annotations

import io
import json
import os
import re
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot_roborecover.curation.annotation.votes import check_name
from lerobot_roborecover.curation.candidates import read_candidates
from lerobot_roborecover.curation.pipeline import requests
from lerobot_roborecover.curation.pipeline.config import BuildPaths, ChainConfig
from lerobot_roborecover.curation.pipeline.requests import assignments
from lerobot_roborecover.curation.render import check_size
from lerobot_roborecover.curation.screen.screening import CURTAILED_LEAST, ScreenRule
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.options import options_of

_REPO = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")
_SIZE = 256
"""Side of the pictures that `collect` takes by default, pixels."""


@dataclass
class _Problems:
    found: list[str] = field(default_factory=list)

    @contextmanager
    def of(self, where: str) -> Generator[None]:
        """Notes a refusal of the block under its place in the file."""
        said = io.StringIO()
        try:
            with redirect_stderr(said):
                yield
        except (OptionError, ScenarioError) as err:
            self.found.append(f"{where}: {' '.join(str(err).split())}")
        except SystemExit:  # a parser's way to refuse, after its usage
            *_, last = said.getvalue().strip().splitlines() or ["an option is not one"]
            self.found.append(f"{where}: {last.partition('error: ')[2] or last}")


def check_build(config: ChainConfig) -> list[str]:
    """What stands against a build.

    Args:
        config: the whole file.

    Returns:
        Problems, one a line, each with its place in the file; empty where there are none.
    """
    problems, places = _Problems(), BuildPaths(config)
    _check_folders(problems, places)
    for name, part in config.collect.items():
        where = f"collect.{name}"
        with problems.of(where):
            if part.dataset:
                _check_dataset(Path(part.dataset), config.platform)
            else:
                requests.collect_options(config, name, part, places.collected(name)).check()
        if part.policy:
            with problems.of(f"{where}.policy"):
                check_checkpoint(part.policy, part.policy_options)
    with problems.of("collect"):
        _check_sizes(config)
    with problems.of("annotate"):
        _check_votes(places.votes, named=bool(config.annotate.votes))
    _check_screen(problems, config, places)
    with problems.of("validate"):
        rejects = config.validate.rejects
        if rejects and not Path(rejects).is_file():
            raise OptionError(f"rejects {rejects} is not there")
        validation = requests.validation_request(config, places)
        _ = validation.rejects
        validation.workplace.check()
        if config.screen.early_stop and validation.rule.runs > CURTAILED_LEAST:
            raise OptionError(
                f"runs {validation.rule.runs}: with screen.early_stop a scenario may have only "
                f"{CURTAILED_LEAST} trials to replay. Set runs to {CURTAILED_LEAST}, or leave early_stop out"
            )
        _check_env(config.platform, validation.env)
    with problems.of("split"):
        requests.split_config(config)
    if config.render is not None:
        with problems.of("render"):
            render = requests.render_request(config, places)
            check_size(render.size)
            _check_env(config.platform, render.env)
    if config.publish is not None:
        with problems.of("publish"):
            _check_publish(config)
    return problems.found


def check_checkpoint(path: str, options: Mapping[str, Any]) -> None:
    """Checks that a policy exists and can be loaded, without holding its weights in memory.

    Args:
        path: folder or Hub id.
        options: of its config.

    Raises:
        OptionError: it cannot; says why.
    """
    from lerobot.policies import get_policy_class

    from lerobot_roborecover.evaluation.loading import policy_config

    try:
        config = policy_config(path, assignments(options))
        get_policy_class(config.type)
    except (OptionError, ScenarioError):
        raise
    except Exception as err:  # draccus, LeRobot and what a policy imports raise types of their own
        raise OptionError(f"{path} cannot be loaded: {type(err).__name__}: {err!s:.300}") from None


def _check_folders(problems: _Problems, places: BuildPaths) -> None:
    with problems.of("out"):
        root = places.root
        there = next(p for p in (root, *root.absolute().parents) if p.exists())
        if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
            raise ScenarioError(f"{root} cannot be written: {there} is no folder that you may write to")
        results = (
            "candidates", "scenarios", "screened", "validated", "split", "rendered", "summary", "old"
        )  # fmt: skip
        for path in (getattr(places, name) for name in results):
            if path.exists() and not path.is_dir():
                raise ScenarioError(f"{path} is a file, and a stage's folder belongs there; move it away")


def _check_dataset(dataset: Path, platform: str) -> None:
    found = read_candidates(dataset)
    if found.platform != platform:
        raise ScenarioError(f"{dataset} is of {found.platform}, this build of {platform}")


_NO_VIDEO = (0, 0)


def _check_sizes(config: ChainConfig) -> None:
    """Candidates are joined without encoding anything again, so that all pictures are of one size."""
    sizes: dict[str, set[tuple[int, int]]] = {}
    for name, part in config.collect.items():
        if part.dataset:
            sizes[name] = _frame_sizes(Path(part.dataset))
        elif str(part.frames or _SIZE) == "none":
            if not config.annotate.automatic:  # programs read numbers
                raise OptionError(f"collect.{name}.frames: none; annotators need something to look at")
            sizes[name] = {_NO_VIDEO}
        elif platform_named(config.platform).sizes_pictures and str(part.frames or _SIZE).isdigit():
            side = int(part.frames or _SIZE)
            if side % 2:
                raise OptionError(f"collect.{name}.frames: {side}; video has an even side, e.g. {side + 1}")
            sizes[name] = {(side, side)}
    if len({frozenset(found) for found in sizes.values() if found}) > 1:
        said = ", ".join(
            f"{name} {' and '.join(f'{w} x {h}' for h, w in sorted(found))}" for name, found in sizes.items()
        )
        raise OptionError(f"frame sizes differ ({said}), and candidates of one build share one; set frames")
    blind = next((name for name, found in sizes.items() if found == {_NO_VIDEO}), None)
    if blind is not None and not config.validate.no_frames:
        raise OptionError(
            f"collect.{blind} has no frames to compare replays with; render it (frames: SIDE), or set "
            "validate.no_frames: true"
        )


def _frame_sizes(dataset: Path) -> set[tuple[int, int]]:
    """Height and width of a dataset's videos, or `_NO_VIDEO`; nothing where that cannot be known."""
    try:
        features = json.loads((dataset / "meta" / "info.json").read_bytes())["features"].values()
        return {tuple(f["shape"][:2]) for f in features if f["dtype"] == "video"} or {_NO_VIDEO}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return set()  # reading the dataset says what is wrong with it


def _check_votes(folder: Path, *, named: bool) -> None:
    if named and folder.exists() and not folder.is_dir():
        raise ScenarioError(f"votes {folder} is a file; name the folder of the annotators' journals")
    for path in sorted(folder.glob("*.jsonl")):
        check_name(path.stem)


def _check_screen(problems: _Problems, config: ChainConfig, places: BuildPaths) -> None:
    with problems.of("screen.keep"):
        requests.filled(ScreenRule, config.screen).check(len(config.screen.policies))
    with problems.of("screen"):
        # The rule was looked at above, and what is wrong with it is said once.
        usual = {one.key: one.default for one in options_of(ScreenRule)}
        request = requests.screen_request(config, places, **usual)
        request.check()
        for one in [(), *(spec.env for spec in request.policies)]:
            _check_env(config.platform, [*request.env, *one])
    for number, policy in enumerate(config.screen.policies):
        with problems.of(f"screen.policies.{number}"):
            check_checkpoint(policy.path, policy.options)


def _check_env(platform: str, options: Sequence[str]) -> None:
    """Checks options of the recovery env type."""
    import draccus

    from lerobot_roborecover.curation.policy_trials import env_config

    try:
        env_config(platform, "none", [f"--{o.removeprefix('--')}" for o in options])
    except (draccus.utils.DraccusException, ValueError, TypeError) as err:
        raise OptionError(f"env: {' '.join(str(err).split())}") from None


def _check_publish(config: ChainConfig) -> None:
    from lerobot_roborecover.datasets.card import license_metadata
    from lerobot_roborecover.datasets.publish import check_version

    assert config.publish is not None
    if not _REPO.fullmatch(config.publish.repo_id):
        raise OptionError(f"repo_id {config.publish.repo_id!r:.80} is not like ORG/NAME")
    check_version(config.publish.version or "1.0.0")
    if any(part.dataset is None for part in config.collect.values()):
        license_metadata(config.license)
