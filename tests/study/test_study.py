"""`python -m recipes.study`: commands, stored outcomes, refusals; a whole study on the fake simulator."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lerobot_roborecover.cli.main import main as roborecover
from lerobot_roborecover.datasets import load_scenarios, write_scenarios
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.scenario import ScenarioError
from recipes.study.__main__ import main
from recipes.study.arms import arms
from recipes.study.definition import read_definition, shipped_study, write_definition
from recipes.study.evaluate import compare_with_stored, run_arm
from recipes.study.make import assemble, chain_for, comes_with_the_package
from recipes.study.outcomes import compare, read_outcomes, write_outcomes
from recipes.study.recipe import StudyRecipe, read_recipe
from recipes.study.stages import stages
from tests.support.factories import fake_dataset, save_policy

COUNT = 4


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    """A study's folder on the fake simulator, without its definition."""
    root = tmp_path_factory.mktemp("study")
    fake_dataset(root / "scenarios", COUNT, horizon=12)
    save_policy(root / "policies" / "act", "act")
    shutil.copytree(root / "policies" / "act", root / "policies" / "other")
    return root


@pytest.fixture
def study(parts, tmp_path):
    root = tmp_path / "data"
    shutil.copytree(parts, root)
    define(root)
    return root


def define(root, **changes) -> None:
    found = {
        "schema_version": 1, "platform": "fake", "policies": {"act": 1, "other": 2}, "base": "act",
        "interventions": ["reversion"], "environment": {"OMP_NUM_THREADS": "1"},
    }  # fmt: skip
    (root / "study.json").write_text(json.dumps({**found, **changes}))


@pytest.mark.slow
def test_every_policy_from_both_starts_then_the_interventions(study, tmp_path):
    found = list(arms(read_definition(study), tmp_path / "out"))
    labels = [a.label for a in found]
    assert labels == [
        "act/recovery", "act/initial", "other/recovery", "other/initial", "reversion/recovery"
    ]  # fmt: skip
    assert [a.trials for a in found] == [1, 1, 2, 2, 1]
    assert all(a.run.runner["max_batch"] == 1 for a in found)
    assert all("--runner.cross_cpu_deterministic=true" in a.run.command_line() for a in found)
    assert {a.run.env["snapshot_dir"] for a in found} == {tmp_path / "out" / "snapshots"}
    assert f"--policy.base.path={study / 'policies' / 'act'}" in found[-1].run.command_line()


@pytest.mark.nightly
@pytest.mark.lerobot
@pytest.mark.slow
def test_a_whole_study_on_the_fake_simulator(study, tmp_path, capsys):
    define(study, policies={"act": 2}, interventions=[])
    out = tmp_path / "out"
    command = ["--data", str(study), "--out", str(out), "--slots", "1"]
    assert main([*command, "--no-report"]) == 0
    said = capsys.readouterr().out
    assert "[2/2] act/" in said
    assert "act/initial: 8 trials" in said
    outcomes = read_outcomes(out / "outcomes.csv")
    assert len(outcomes) == COUNT * (2 + 2)
    assert len(list((out / "snapshots").glob("*.snapshot"))) == 2 * COUNT

    # Stored, and run again: elsewhere, with more simulators, on a part of the scenarios.
    write_outcomes(study / "outcomes.csv", outcomes)
    again = ["--data", str(study), "--out", str(tmp_path / "again"), "--slots", "2", "--every", "2"]
    assert main([*again, "--no-report"]) == 0
    assert "8 of 8 trials came out as stored" in capsys.readouterr().out

    # A stored outcome that is another one is distinguished, and what has finished is not run again.
    key = next(k for k in outcomes if k[0] == "act/recovery")
    write_outcomes(study / "outcomes.csv", {**outcomes, key: ("success", 3)})
    before = (out / "trials" / "act-recovery" / "output.log").stat().st_mtime_ns
    assert main(command) == 1
    assert (out / "trials" / "act-recovery" / "output.log").stat().st_mtime_ns == before
    assert f"act/recovery {key[1]} trial {key[2]}: stored success after 3" in capsys.readouterr().out
    assert (out / "report" / "report.html").exists()


trial = st.tuples(st.sampled_from(["a/recovery", "b"]), st.text('abc," \n', min_size=1), st.integers(0, 9))
outcome = st.tuples(st.sampled_from(["success", "horizon"]), st.integers(0, 500))


@pytest.mark.slow
@given(st.dictionaries(trial, outcome))
def test_outcomes_survive_their_file(tmp_path_factory, outcomes):
    path = tmp_path_factory.mktemp("outcomes") / "outcomes.csv"
    write_outcomes(path, outcomes)
    assert read_outcomes(path) == outcomes


@pytest.mark.slow
@given(st.dictionaries(trial, outcome), st.dictionaries(trial, outcome))
def test_each_trial_of_today_is_counted_once(stored, today):
    found = compare(stored, today)
    assert found.same + len(found.different) + found.unknown == len(today)
    assert all(stored[key] == a and today[key] == b and a != b for key, a, b in found.different)


@pytest.mark.slow
def test_steps_may_differ_only_where_kernels_cannot_be_chosen(study, tmp_path, monkeypatch):
    stored = {("act", "s", i): (o, n) for i, (o, n) in enumerate([("success", 20), ("horizon", 45)] * 2)}
    today = {**stored, ("act", "s", 0): ("success", 22), ("act", "s", 2): ("success", 17)}
    write_outcomes(study / "outcomes.csv", stored)
    found = read_definition(study)
    monkeypatch.setattr("recipes.study.evaluate.outcomes_of", lambda done: today)
    for can, different, close in ((True, {0, 2}, set()), (False, {2}, {0})):
        monkeypatch.setattr("recipes.study.evaluate.has_kernels", lambda can=can: can)
        compared = compare_with_stored(found, [])
        assert ({d[0][2] for d in compared.different}, {d[0][2] for d in compared.close}) == (
            different,
            close,
        )
        assert compared.text().startswith("2 of 4 trials came out as stored, to the step")
    assert "1 more ended alike, at most 2 steps sooner or later" in compared.text()
    # An outcome is never close to another one, however near the steps.
    other = compare({("a", "s", 0): ("success", 45)}, {("a", "s", 0): ("horizon", 45)}, 10)
    assert (len(other.different), len(other.close)) == (1, 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"schema_version": 9}, "field schema_version: 9"),
        ({"policies": {}}, "field policies"),
        ({"policies": {"../act": 1}}, "field policies: '../act'"),
        ({"policies": {"act": 0}}, "field policies.act: 0; it must be a count from 1 to 1000"),
        ({"policies": {"act": 1, "missing": 1}}, "names policy missing"),
        ({"base": "nobody"}, "field base: 'nobody'; it must be one of"),
        ({"interventions": ["human"]}, "field interventions: 'human'"),
        ({"interventions": ["correction"]}, "mode correction needs a correction"),
        ({"env": {"obs_type": 3}}, "field env"),
        ({"dataset": 3}, "field dataset: 3; it must be a text"),
        ({"policies_folder": "policies/none"}, "run this in the top folder of a checkout"),
        ({"learned_folder": "x", "interventions": ["correction"]}, "needs a correction, but x/correction"),
        ({"colour": "red"}, "not a study's definition"),
    ],
)  # fmt: skip
def test_a_definition_that_cannot_be_used(study, changes, message):
    define(study, **changes)
    with pytest.raises(ScenarioError, match=r"study\.json") as caught:
        read_definition(study)
    assert message in str(caught.value)


def test_a_study_takes_another_s_correction_and_monitor(study, tmp_path):
    (tmp_path / "other" / "correction").mkdir(parents=True)
    define(study, learned_folder=str(other := tmp_path / "other"), interventions=["correction"])
    write_definition(found := read_definition(study))
    assert read_definition(study) == found
    assert (found.correction, found.monitor) == (other / "correction", other / "monitor")


@pytest.mark.slow
def test_refusals(study, tmp_path, capsys):
    def refused(*argv: str) -> str:
        assert main(argv) == 2
        return capsys.readouterr().err

    assert "has no study.json" in refused("--data", str(tmp_path))
    assert "--stride=0: a count from 1" in refused("--data", str(study), "--stride", "0")
    assert "--jobs=-1: a count" in refused("--data", str(study), "--jobs", "-1")
    assert "add --make" in refused("--stage", "policies")
    assert "add --make" in refused("--shipped-scenarios")
    (study / "outcomes.csv").write_text("arm,scenario_id,trial,outcome,steps\na,b,c,d,e\n")
    with pytest.raises(ScenarioError, match="line 2"):
        read_outcomes(study / "outcomes.csv")


@pytest.mark.lerobot
@pytest.mark.nightly
def test_an_arm_that_cannot_start_is_told_before_the_first_trial_of_any(study, tmp_path, capsys):
    out = tmp_path / "out"
    save_policy(study / "correction", "act", action=3)
    define(study, policies={"act": 1}, interventions=["reversion", "correction"])
    assert main(["--data", str(study), "--out", str(out), "--no-report"]) == 2
    message = capsys.readouterr().err
    (told,) = (line for line in message.splitlines() if "cannot start" in line)
    assert "correction-recovery/run.yaml: --policy.correction.path=" in told
    assert "action space is (3,)" in told
    assert "run the same command again" in message
    assert not list(out.rglob("trials.jsonl"))


@pytest.mark.lerobot
@pytest.mark.nightly
def test_a_policy_that_fails_is_told_with_the_end_of_its_output(study, tmp_path):
    define(study, policies={"act": 1}, interventions=[])
    (study / "policies" / "act" / "config.json").write_text("{}")
    found = read_definition(study)
    with pytest.raises(ScenarioError, match=r"(?s)ended with status.*Run the same command again"):
        run_arm(next(iter(arms(found, tmp_path / "out"))), found, ())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["libero", "libero_0", "metaworld_recovery"])
def test_a_study_whose_policies_are_there_does_not_train_them(tmp_path, name):
    recipe = read_recipe(name)
    found = stages(tmp_path, recipe, chain_for(tmp_path, recipe))
    policies, *_, metrics = found
    assert policies.commands == ()
    assert all(path.is_dir() for path in policies.done)
    assert metrics.name == "monitor metrics"
    chain = chain_for(tmp_path, recipe)
    taken_by_chain = {part.dataset for part in chain.collect.values() if part.dataset}
    assert taken_by_chain == {str(tmp_path / name) for name in recipe.recordings}
    # Its base was kept out of screening: it is run on the training scenarios before donors are sought.
    assert recipe.base not in {p.name for p in chain.screen.policies}
    names = [s.name for s in found]
    assert names.index("scenarios") + 1 == names.index("base trials") == names.index("donors") - 1
    run, donors = found[names.index("base trials")].commands[0], found[names.index("donors")].commands[0]
    assert "--env.split=train" in run
    assert str(tmp_path / "base_trials" / "trials.jsonl") in donors
    # Of a donor that repeats itself what screening kept is enough; one that draws noise is run.
    repeats = [p for p in chain.screen.policies if p.deterministic]
    assert donors.count("--donor") == len(chain.screen.policies) - len(repeats)
    assert donors.count("--deterministic") == donors.count("--trials-from") == len(repeats)
    # What screening ran, the monitor's data need not run again.
    words = found[names.index("monitor data")].commands[0]
    paths = [str(p.path) for p in chain.screen.policies]
    assert [words[i + 1] for i, word in enumerate(words) if word == "--policy"] == paths
    assert words.count("--trials-from") == len(paths)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["libero", "libero_0", "metaworld_recovery"])
def test_a_set_that_ships_need_not_be_built_again(tmp_path, name):
    """Its screening trials do not ship: the panel is tried once more, and is all that is read afterwards."""
    recipe = read_recipe(name)
    chain = chain_for(tmp_path, recipe)
    found = {s.name: s for s in stages(tmp_path, recipe, chain, shipped=True)}
    assert list(found) == [
        "policies", "panel trials", "base trials", "donors", "correction", "monitor data", "monitor",
        "monitor metrics",
    ]  # fmt: skip
    for panelist, run, done in zip(
        chain.screen.policies, found["panel trials"].commands, found["panel trials"].done, strict=True
    ):
        assert f"--env.scenarios={recipe.dataset}" in run
        assert f"--eval.n_episodes={1 if panelist.deterministic else chain.screen.trials}" in run
        assert f"--output_dir={done.parent}" in run
        assert "--env.record_actions=true" in run
        assert str(done.parent / "trials.jsonl") in found["donors"].commands[0]
        assert str(done.parent) in found["monitor data"].commands[0]
    everything = [word for s in found.values() for command in s.commands for word in command]
    assert not any(str(tmp_path / "scenarios") in word for word in everything)


@pytest.mark.slow
def test_a_set_that_does_not_ship_has_to_be_built(tmp_path):
    recipe = replace(read_recipe("libero"), dataset="nowhere")
    with pytest.raises(ScenarioError, match="'nowhere' of this study does not come with the package"):
        stages(tmp_path, recipe, chain_for(tmp_path, recipe), shipped=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("policies_folder: there\ntrain_policies: [a]", "not both"),
        ("", "not neither"),
        ("policies_folder: there\nbase: diffusion", "base 'diffusion' is not one of act"),
        ("policies_folder: there\npolicy: act", "policy"),
    ],
)
def test_a_recipe_that_makes_no_sense_is_refused(tmp_path, monkeypatch, text, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "policies" / "study").mkdir(parents=True)
    head = {"platform": "fake", "base": "act", "policies": "{act: 1}", "chain": "c", "chain_root": "r"}
    lines = [f"{k}: {v}" for k, v in head.items() if f"\n{k}:" not in text]
    (tmp_path / "policies" / "study" / "mine.yaml").write_text("\n".join([*lines, text]))
    with pytest.raises(OptionError, match=said):
        read_recipe("mine")
    with pytest.raises(ScenarioError, match="there are mine"):
        read_recipe("other")


@pytest.mark.slow
def test_a_study_that_does_not_ship_is_named(capsys):
    assert main(["--name", "robotwin"]) == 2
    said = capsys.readouterr().err
    assert "no study 'robotwin' in policies/study; there are" in said
    assert "metaworld" in said


@pytest.mark.slow
def test_the_old_name_works_in_a_clone_and_says_where_one_is_needed(tmp_path, monkeypatch, capsys):
    assert roborecover(["study", "--stride", "0"]) == 2
    note, refused = capsys.readouterr().err.splitlines()
    assert note == 'note: "roborecover study" is now "python -m recipes.study"'
    assert refused == "python -m recipes.study: --stride=0: a count from 1"
    monkeypatch.chdir(tmp_path)
    assert roborecover(["study", "--use-stored-outcomes"]) == 2
    _, refused = capsys.readouterr().err.splitlines()
    assert refused == (
        "roborecover study: studies are not installed. Run them in the top folder of a clone of the "
        "repository: python -m recipes.study"
    )


@pytest.mark.slow
def test_a_study_of_the_checkout_uses_its_policies_and_a_set_of_the_package(study, tmp_path, monkeypatch):
    checkout = tmp_path / "checkout"
    shutil.copytree(study / "policies", checkout / "policies" / "fake")
    where = checkout / "policies" / "study" / "mine"
    where.mkdir(parents=True)
    define(where, dataset="metaworld_starter", policies_folder="policies/fake")
    monkeypatch.chdir(checkout)
    found = read_definition(shipped_study("mine"))
    write_definition(found)
    assert read_definition(found.root) == found
    run = next(iter(arms(found, tmp_path / "out"))).run.command_line()
    assert "--env.scenarios=metaworld_starter" in run
    assert "--policy.path=policies/fake/act" in run
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ScenarioError, match="run this in the top folder of a clone"):
        shipped_study("mine")


@pytest.mark.slow
@pytest.mark.lerobot
@pytest.mark.parametrize("elsewhere", [False, True])
def test_what_is_made_is_put_together_as_a_study(parts, tmp_path, elsewhere):
    """Policies as they were screened, or where the checkout has them; Correction in half precision."""
    from safetensors.torch import load_file

    out, checkpoint = tmp_path / "out", parts / "policies" / "act"
    fake_dataset(out / "scenarios" / "split", COUNT, horizon=12)
    for made in ("policies/act", "correction", "monitor_training/checkpoints/last/pretrained_model"):
        shutil.copytree(checkpoint, out / made)
    recipe = StudyRecipe(
        "fake", {"act": 1}, "act", "c", "r", interventions=["correction"],
        policies_folder=str(out / "policies") if elsewhere else None,
    )  # fmt: skip
    study = assemble(out, recipe)
    shipped = replace(recipe, dataset="metaworld_starter")
    assert assemble(out, shipped, shipped=True).scenarios == "metaworld_starter"
    assert not (out / "data" / "scenarios").exists()
    assert assemble(out, shipped).scenarios == str(out / "data" / "scenarios"), "others were made"
    study = assemble(out, recipe)
    assert (study.root / "policies").exists() is not elsewhere
    assert study.policy("act").is_dir()
    assert [s.id for s in load_scenarios(study.scenarios)] == [
        s.id for s in load_scenarios(parts / "scenarios")
    ]
    kinds = {
        name: {str(v.dtype) for v in load_file(folder / "model.safetensors").values()}
        for name, folder in {"correction": study.correction, "monitor": study.monitor}.items()
    }
    assert kinds == {"correction": {"torch.float16"}, "monitor": {"torch.float32"}}
    assert read_definition(study.root) == study


@pytest.mark.slow
def test_a_study_names_a_set_of_the_package_where_its_scenarios_are_the_same(tmp_path):
    shipped = load_scenarios("metaworld_starter")
    same, other = tmp_path / "same", tmp_path / "other"
    write_scenarios(same, list(shipped)[::-1], description="in another order")
    changed = replace(shipped[0], split="train" if shipped[0].split == "test" else "test")
    write_scenarios(other, [changed, *shipped[1:]], description="another split")
    renamed = tmp_path / "renamed"
    write_scenarios(renamed, [replace(shipped[0], id="renamed"), *shipped[1:]], description="another name")
    assert comes_with_the_package(same, "metaworld_starter")
    assert not comes_with_the_package(renamed, "metaworld_starter")
    assert not comes_with_the_package(other, "metaworld_starter")
    assert not comes_with_the_package(same, "")


@pytest.mark.slow
def test_the_stages_of_making_one_come_in_the_order_of_their_needs(tmp_path):
    recipe = read_recipe("metaworld")
    found = stages(tmp_path, recipe, chain_for(tmp_path, recipe))
    assert [s.name for s in found] == [
        "policies", *recipe.recordings, "scenarios", "donors", "correction", "monitor data", "monitor",
        "monitor metrics",
    ]  # fmt: skip
    assert len({path for s in found for path in s.done}) == sum(len(s.done) for s in found)
    assert {path.name for path in found[0].done} == set(recipe.policies), "none of them is forgotten"
