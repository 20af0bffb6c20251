"""Detectors: what each says, that nothing but its window decides, that they come back from disk, and what is
refused before anything runs."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lerobot_roborecover.policies.detectors.interface import DetectorError
from tests.support.factories import save_policy

pytestmark = pytest.mark.lerobot
STATE, SCENE = "observation.state", "observation.environment_state"


def walk_of(steps: int, seed: int = 0) -> list[dict]:
    """Observations of a random walk."""
    import torch

    rng = np.random.default_rng(seed)
    states = np.cumsum(rng.normal(0, 0.1, (steps, 4)), axis=0).astype(np.float32)
    scenes = rng.normal(0, 1, (steps, 6)).astype(np.float32)
    return [
        {STATE: torch.from_numpy(s), SCENE: torch.from_numpy(e)} for s, e in zip(states, scenes, strict=True)
    ]


def windows(observations, past: int, *, text: str = "go", seed: int = 7, **known) -> list:
    from lerobot_roborecover.policies.detectors.interface import DetectorWindow, StepObservation

    observations = [StepObservation(o) for o in observations]
    return [
        DetectorWindow(observations[max(n - past, 0) : n + 1], text, n, seed, **known)
        for n in range(len(observations))
    ]


def load(what: str, **options):
    from lerobot_roborecover.policies.detectors.loading import load_detector

    return load_detector(what, "cpu", **options)


@pytest.fixture(scope="module")
def probes(tmp_path_factory):
    """Into a policy that is deterministic, and into one that draws noise and keeps observations."""
    from lerobot_roborecover.policies.detectors.probe import PolicyProbe
    from lerobot_roborecover.policies.interventions.configuration_intervention import MemberConfig
    from lerobot_roborecover.policies.interventions.members import load_member

    made = {}
    for kind in ("act", "diffusion"):
        folder = save_policy(tmp_path_factory.mktemp(kind) / "policy", kind)
        member = load_member("base", MemberConfig(str(folder)), "cpu", {}, None)
        made[kind] = PolicyProbe(*member.parts[:2])
    return made


def test_rules_say_what_they_are_for():
    seen = walk_of(12)
    constant = load("constant,rate=0.25")
    one = constant.judge_windows(windows(seen, 0))
    assert one.triggers.tolist() == (one.scores > 0.75).tolist()
    draws = np.concatenate([constant.judge_windows(windows(seen, 0, seed=s)).scores for s in range(400)])
    assert 0.22 < (draws > 0.75).mean() < 0.28  # a quarter of 4,800 draws
    assert np.std(draws) == pytest.approx(math.sqrt(1 / 12), rel=0.05)  # evenly spread

    elapsed = load("elapsed,steps=10").judge_windows(windows(seen, 0))
    np.testing.assert_allclose(elapsed.scores, np.arange(12) / 10, rtol=1e-6)
    assert not elapsed.triggers.any()  # it has no threshold

    still = [seen[0]] * 12
    watch = load(f"no_progress,steps=5,scale=0.5,keys={STATE}")
    scores = watch.judge_windows(windows(still, 5)).scores
    assert scores.tolist() == [0.0] * 5 + [1.0] * 7
    moving = watch.judge_windows(windows(seen, 5)).scores
    states = np.stack([o[STATE].numpy() for o in seen])
    furthest = max(np.linalg.norm(states[k] - states[3]) for k in range(3, 9))
    assert moving[8] == pytest.approx(0.5 / (0.5 + furthest), rel=1e-5)

    outcome = load("oracle").judge_windows(windows(seen[:2], 0, will_fail=1.0))
    assert outcome.triggers.all()
    unknown = load("oracle,truth=recovery_point").judge_windows(windows(seen[:2], 0))
    assert np.isnan(unknown.scores).all()
    assert not unknown.triggers.any()


@pytest.mark.parametrize("method", ["knn", "mahalanobis"])
def test_distance_from_training_states(method, tmp_path):
    import torch

    rng = np.random.default_rng(3)
    mixed = rng.normal(0, 1, (300, 10)) @ rng.normal(0, 1, (10, 10))
    mixed[:, 4] = 2.0  # never changes
    known = {STATE: torch.from_numpy(mixed[:, :4]), SCENE: torch.from_numpy(mixed[:, 4:])}
    detector = load(f"state_distance,method={method},k=3,by_task=false")
    assert not detector.fitted
    detector.fit(known, ["go"] * 300)
    asked = [
        {STATE: torch.from_numpy(r[:4]).float(), SCENE: torch.from_numpy(r[4:]).float()}
        for r in (mixed[0], mixed[0] + 0.01, mixed[0] + 5.0)
    ]
    said = detector.judge_windows(windows(asked, 0)).scores
    assert said[2] > 2 * said[1]

    std = np.where(mixed.std(0, ddof=1) < 1e-6, 1.0, mixed.std(0, ddof=1))
    z = (mixed - mixed.mean(0)) / std
    point = (mixed[0] + 5.0 - mixed.mean(0)) / std
    if method == "knn":
        wanted = np.sort(np.linalg.norm(z - point, axis=1))[2]
    else:
        covariance = np.cov(z.T) + 1e-3 * np.eye(10)
        wanted = math.sqrt((point - z.mean(0)) @ np.linalg.solve(covariance, point - z.mean(0)))
    assert said[2] == pytest.approx(wanted / math.sqrt(10), rel=1e-3)

    detector.config.threshold = float(said[1] + said[2]) / 2
    detector.save_pretrained(tmp_path)
    again = load(str(tmp_path)).judge_windows(windows(asked, 0))
    np.testing.assert_array_equal(again.scores, said)
    assert again.triggers.tolist() == [False, False, True]
    cut = {STATE: asked[0][STATE][:3], SCENE: asked[0][SCENE]}
    with pytest.raises(DetectorError, match="fitted to 10 numbers; here are 9"):
        detector.judge_windows(windows([cut], 0))


def test_states_are_compared_within_their_task():
    import torch

    detector = load(f"state_distance,k=1,keys={STATE}")
    near, far = torch.zeros(50, 4), torch.full((50, 4), 10.0)
    near += torch.arange(50)[:, None] * 0.01
    detector.fit({STATE: torch.cat([near, far])}, ["near"] * 50 + ["far"] * 50)
    at = [{STATE: torch.full((4,), 10.0)}]
    said = {t: detector.judge_windows(windows(at, 0, text=t)).scores[0] for t in ("near", "far", "else")}
    assert said["far"] == said["else"] == pytest.approx(0.0, abs=1e-6)
    assert said["near"] > 1.0


def test_chunks_that_contradict_each_other():
    import torch

    from lerobot_roborecover.policies.detectors.interface import DetectorWindow, StepObservation

    detector = load("chunk_disagreement,lag=1,samples=2")
    line = torch.arange(5.0)

    def score(before, now):
        observations = [StepObservation({}, c[:, :, None]) for c in (before, now)]
        return float(detector.judge_windows([DetectorWindow(observations, "go", 1)]).scores[0])

    same = line.expand(2, 5)
    assert score(same, same + 1) == pytest.approx(0.0)  # the plan goes on as it was
    # Twice the distance of the four shared steps, over the root of their number.
    assert score(same, same + 4) == pytest.approx(2 * 3 * 2 / math.sqrt(4))
    # Undecided between two ways, both times alike: no contradiction.
    two = torch.stack([line, -line])
    assert score(two, torch.stack([line + 1, -line - 1])) == pytest.approx(0.0, abs=1e-6)
    assert (
        float(
            detector.judge_windows([DetectorWindow([StepObservation({}, two[:, :, None])], "go", 0)]).scores[
                0
            ]
        )
        == 0.0
    )
    with pytest.raises(DetectorError, match=r"lag=1: the policy's chunks have 1 steps.*Set lag below 1"):
        score(torch.zeros(2, 1), torch.zeros(2, 1))


@pytest.mark.parametrize("kind", ["act", "diffusion"])
def test_looking_into_a_policy_touches_nothing_and_depends_on_nothing_else(kind, probes):
    import torch

    from lerobot_roborecover.policies.detectors.interface import DetectorNeeds

    probe, seen = probes[kind], walk_of(6)
    asked = [seen[max(n - probe.past, 0) : n + 1] for n in range(6)]
    needs = DetectorNeeds(chunks=3, internals=True)
    torch.manual_seed(5)
    before = torch.get_rng_state()
    together = probe.look(asked, ["go"] * 6, list(range(6)), needs)
    assert torch.equal(torch.get_rng_state(), before)
    for n in (0, 4):
        ((chunks, features),) = probe.look([asked[n]], ["go"], [n], needs)
        torch.testing.assert_close(chunks, together[n][0])
        torch.testing.assert_close(features, together[n][1])
    chunks, features = together[3]
    assert chunks.shape == (3, 4, 2)
    assert features.shape == (16,)
    assert torch.equal(chunks[0], chunks[1]) == (kind == "act")
    # Features are those of this observation, and chunks those that the policy itself gives.
    assert not torch.equal(features, together[2][1])
    if kind == "act":
        policy = probe._policy
        batch = probe._pre({k: v[None] for k, v in seen[3].items()} | {"task": ["go"]})
        torch.testing.assert_close(policy.predict_action_chunk(batch)[0], chunks[0])
    else:  # it reads two observations
        ((other, _),) = probe.look([[seen[5], seen[3]]], ["go"], [3], needs)
        assert not torch.equal(other, chunks)


def test_a_network_on_features_learns_and_comes_back(tmp_path):
    import torch

    from lerobot_roborecover.policies.detectors.interface import DetectorWindow, StepObservation

    rng = np.random.default_rng(0)
    labels = torch.from_numpy((np.arange(400) % 4 == 0).astype(np.float32))
    features = torch.from_numpy(rng.normal(0, 1, (400, 8)).astype(np.float32))
    features[:, 0] += 3 * labels
    detector = load("policy_features,steps=150,hidden_dim=8,learning_rate=0.02")
    state = torch.get_rng_state()
    detector.fit(features, labels)
    assert torch.equal(torch.get_rng_state(), state)
    asked = [DetectorWindow([StepObservation({}, None, f)], "go", 0) for f in features]
    said = detector.judge_windows(asked).scores
    assert said[labels == 1].mean() > 0.7 > 0.4 > said[labels == 0].mean()
    detector.save_pretrained(tmp_path)
    np.testing.assert_array_equal(load(str(tmp_path)).judge_windows(asked).scores, said)
    with pytest.raises(DetectorError, match="400 frames where the policy goes on by itself and 0"):
        load("policy_features").fit(features, torch.zeros(400))
    with pytest.raises(DetectorError, match="fitted to 8 features; the policy has 3"):
        detector.judge_windows([DetectorWindow([StepObservation({}, None, torch.zeros(3))], "go", 0)])


def test_an_expected_gain_is_the_mean_of_what_came_of_it(tmp_path):
    """Half rescued and half harmed is no gain, three rescued of four are 0.75; never a threshold below 0."""
    import torch

    from lerobot_roborecover.policies.detectors.interface import DetectorWindow, StepObservation

    places = np.eye(3, dtype=np.float32)
    gains = {0: [1, -1, 1, -1], 1: [1, 1, 1, 0], 2: [0, 0, -1, 0]}
    features = torch.from_numpy(np.stack([places[k] for k, v in gains.items() for _ in v] * 20))
    found = torch.tensor([g for v in gains.values() for g in v] * 20)
    detector = load("recovery_gain,steps=800,hidden_dim=16,learning_rate=0.02,dropout=0,weight_decay=0")
    detector.fit(features, found)
    assert detector.config.labels == {"rescued": 100, "harmed": 60, "alike": 80}
    asked = [DetectorWindow([StepObservation({}, None, torch.from_numpy(p))], "go", 0) for p in places]
    said = detector.judge_windows(asked)
    np.testing.assert_allclose(said.scores, [0.0, 0.75, -0.25], atol=0.05)
    assert list(said.triggers[1:]) == [True, False]
    detector.save_pretrained(tmp_path)
    again = load(str(tmp_path))
    np.testing.assert_array_equal(again.judge_windows(asked).scores, said.scores)
    assert (again.config.threshold, again.least_threshold) == (0.0, 0.0)
    with pytest.raises(DetectorError, match="of 3 forks the intervention rescued none"):
        load("recovery_gain").fit(features[:3], -torch.ones(3))


@pytest.mark.parametrize("kind", ["act", "diffusion"])
def test_step_by_step_it_says_what_it_says_afterwards(kind, probes):
    """A detector beside trials under way, in a batch with another one, against windows made afterwards."""
    from lerobot_roborecover.policies.detectors.interface import (
        DetectorNeeds,
        DetectorWindow,
        StepObservation,
    )
    from lerobot_roborecover.policies.detectors.online import OnlineDetector, noise_seed

    detector = load("chunk_disagreement,lag=2,samples=2")
    probe = probes[kind]
    trials = {11: walk_of(7, 1), 12: walk_of(7, 2)}
    watcher = OnlineDetector(detector, probe)
    watches = [watcher.start(seed) for seed in trials]
    live = []
    for step in range(7):
        shown = [walk[step] for walk in trials.values()]
        live.append(watcher.judge(watches, shown, ["go"] * 2).scores)
    for at, (seed, walk) in enumerate(trials.items()):
        needs = DetectorNeeds(chunks=2)
        chunks = [
            probe.look([walk[max(n - probe.past, 0) : n + 1]], ["go"], [noise_seed(seed, n)], needs)[0][0]
            for n in range(7)
        ]
        observations = [StepObservation(o, c) for o, c in zip(walk, chunks, strict=True)]
        after = detector.judge_windows(
            [DetectorWindow(observations[max(n - 2, 0) : n + 1], "go", n, seed) for n in range(7)]
        )
        np.testing.assert_allclose([row[at] for row in live], after.scores, rtol=1e-4, atol=1e-6)
        assert after.scores[6] > 0


def test_a_monitor_is_a_detector_that_looks_at_now():
    import torch
    from lerobot.configs import FeatureType, PolicyFeature

    from lerobot_roborecover.policies.detectors.monitor.configuration_roborecover_monitor_small import (
        RoboRecoverMonitorSmallConfig,
    )
    from lerobot_roborecover.policies.detectors.monitor.modeling_roborecover_monitor_small import (
        RoboRecoverMonitorSmallRewardModel,
    )

    torch.manual_seed(0)
    config = RoboRecoverMonitorSmallConfig(device="cpu", hidden_dim=8, n_layers=1, max_batch=3)
    config.input_features = {STATE: PolicyFeature(FeatureType.STATE, (4,))}
    monitor = RoboRecoverMonitorSmallRewardModel(config).eval()
    assert set(monitor.needs.features) == {STATE}
    assert (monitor.max_batch, monitor.decides, monitor.probabilities) == (3, True, True)
    seen = walk_of(3)
    own = monitor.judge_batch({STATE: torch.stack([o[STATE] for o in seen]), "task": ["go"] * 3})
    found = monitor.judge_windows(windows(seen, 2))
    np.testing.assert_array_equal(found.scores, own.scores)
    np.testing.assert_array_equal(found.triggers, own.scores > 0.5)


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("constant,rate=1.5", r"constant, rate=1.5: must be from 0 to 1"),
        (
            "constant,speed=1",
            r"detector constant: no option 'speed'; it has \['max_batch', 'policy', 'rate', 'thr",
        ),
        ("constant,rate=much", "detector constant: .*much"),
        ("constant,fast", "'fast' is no option. Write constant,name=value"),
        ("state_distance,method=cosine", "must be knn or mahalanobis"),
        ("oracle,truth=hearsay", "must be recovery_point or outcome"),
        ("no_such_kind", "Kinds that need no checkpoint: chunk_disagreement, constant"),
    ],
)
def test_options_that_cannot_be_used(what, message, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    with pytest.raises(DetectorError, match=message):
        load(what)


def test_what_is_missing_is_said_before_anything_runs(probes):
    from lerobot.configs import FeatureType, PolicyFeature

    from lerobot_roborecover.policies.detectors.interface import DetectorNeeds
    from lerobot_roborecover.policies.detectors.loading import check_needs

    there = {STATE: PolicyFeature(FeatureType.STATE, (4,))}
    with pytest.raises(
        DetectorError, match=r"x reads observation.images.top; .* only \['observation.state'\]. Use"
    ):
        check_needs("x", DetectorNeeds(features={"observation.images.top": None}), there, None)
    wanted = {STATE: PolicyFeature(FeatureType.STATE, (3,))}
    with pytest.raises(DetectorError, match=r"of shape \(3,\); the environment's is \(4,\)"):
        check_needs("x", DetectorNeeds(features=wanted), there, None)
    with pytest.raises(DetectorError, match="needs to know the outcome, which is unknown while a trial"):
        check_needs("x", load("oracle").needs, there, None)
    check_needs("x", load("oracle").needs, there, None, ("outcome",))
    with pytest.raises(
        DetectorError, match="looks into the policy that acts, which is not a LeRobot checkpoint"
    ):
        check_needs("x", DetectorNeeds(chunks=1), there, None)
    check_needs("x", DetectorNeeds(chunks=1, internals=True), there, probes["diffusion"])
    probes["act"].kind, kind = "tdmpc", probes["act"].kind
    try:
        with pytest.raises(
            DetectorError, match=r"a 'tdmpc' policy gives none beside a trial. It works with \['act'"
        ):
            check_needs("x", DetectorNeeds(chunks=1), there, probes["act"])
        with pytest.raises(DetectorError, match="where a 'tdmpc' policy has them is not known"):
            check_needs("x", DetectorNeeds(internals=True), there, probes["act"])
    finally:
        probes["act"].kind = kind
