"""What was converted before: replayed again, or compared with what takes its place."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lerobot_roborecover.datasets.load import load_scenarios
from lerobot_roborecover.datasets.release.convert import Conversion, Problem
from lerobot_roborecover.datasets.release.fixtures import compare_fixtures
from lerobot_roborecover.datasets.release.json_form import KEY
from lerobot_roborecover.datasets.release.record import RULES, Reading, check_seed
from lerobot_roborecover.datasets.schema import FOLDER, MANIFEST_FILE
from lerobot_roborecover.scenario import Scenario, ScenarioError


def read_converted(root: Path, reading: Reading = RULES) -> Conversion:
    """A converted dataset as a conversion, to be replayed again with the fixtures that it has recorded.

    Raises:
        ScenarioError: it was not made from the release.
    """
    found = load_scenarios(root)
    result = Conversion(found.platform)
    for scenario in found:
        if not isinstance(scenario.provenance.get(KEY), dict):
            raise ScenarioError(
                f"{root}: scenario {scenario.id} was not converted from the release, so that there is no "
                "record to compare its first state with"
            )
        try:
            if scenario.platform == "libero":
                check_seed(scenario.reset.seed, reading)
        except ScenarioError as err:
            result.failures.append(Problem(str(root), None, scenario.id, f"scenario {scenario.id}: {err}"))
        else:
            result.scenarios.append(scenario)
    return result


def read_earlier(out: Path, replayed: bool) -> dict[str, Scenario]:
    """The scenarios that a conversion is about to take the place of, by id.

    Args:
        out: where it will be written.
        replayed: whether it is fingerprinted.

    Raises:
        ScenarioError: something that took long to make would be lost.
    """
    if not (out / FOLDER / MANIFEST_FILE).is_file():
        return {}
    if (out / "meta" / "info.json").is_file():
        raise ScenarioError(f"{out} holds rendered episodes, which would be lost; name another --out")
    found = {s.id: s for s in load_scenarios(out)}
    if not replayed and any(s.fingerprint for s in found.values()):
        raise ScenarioError(
            f"{out} is fingerprinted, which would be lost; say --fingerprint, or name another --out"
        )
    return found


def compare_with_earlier(out: Path, earlier: dict[str, Scenario], now: Sequence[Scenario]) -> list[Problem]:
    """Compares replayed scenarios with the same ones of an earlier replay.

    Args:
        out: where the earlier ones are.
        earlier: by id.
        now: what is to take their place.

    Returns:
        A warning for every scenario whose handoff is in another state than it was, fixtures apart.

    Raises:
        ScenarioError: fixtures are elsewhere than they were: one of the two replays is not the release's.
    """
    changed = []
    for scenario in now:
        before = earlier.get(scenario.id)
        if before is None or scenario.fingerprint is None or before.fingerprint is None:
            continue
        if before.reset.fixtures:
            try:
                compare_fixtures(scenario.reset.fixtures, before.reset.fixtures, f"{out} has it")
            except ScenarioError as err:
                raise ScenarioError(
                    f"scenario {scenario.id}: {err}. Nothing was written; to keep both, name another --out"
                ) from None
        then, here = before.fingerprint, scenario.fingerprint
        if then.state_sha256 != here.state_sha256:
            versions = ", ".join(
                f"{k} {then.versions.get(k)} then, {v} now"
                for k, v in here.versions.items()
                if then.versions.get(k) != v
            )
            changed.append(
                Problem(
                    scenario.provenance[KEY]["split_row"]["path"],
                    None,
                    scenario.id,
                    f"the handoff is in another state than {out} had it ({versions or 'the same versions'})",
                )
            )
    return changed
