"""Recovery points of robots: a scenario dataset like any other, and nothing unusable gets through."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lerobot_roborecover.datasets.card import make_card
from lerobot_roborecover.datasets.inspect import describe
from lerobot_roborecover.datasets.schema import to_row
from lerobot_roborecover.platforms import SimulatorError, platform_named, platform_names
from lerobot_roborecover.robot.points import point_of, read_points, write_points
from lerobot_roborecover.scenario import ScenarioError
from tests.support.robot_points import JOINTS, made_point, pictures_of


def test_a_point_comes_back_from_disk_as_it_was_written(tmp_path):
    made = [made_point("a", seed=0), made_point("b", seed=1)]
    shown = {s.id: pictures_of(seed) for seed, s in enumerate(made)}
    write_points(tmp_path / "points", made, shown)
    found = read_points(tmp_path / "points")
    for read, scenario in zip(found.points, made, strict=True):
        assert to_row(read.scenario) | {"prefix": 0} == to_row(scenario) | {"prefix": 0}
    assert [p.scenario.sha256() for p in found.points] == [s.sha256() for s in made]
    point = found.points[1]
    assert (point.robot_type, point.time_limit_s, point.quasi_static) == ("so101_follower", 10.0, True)
    assert point.scenario.task.horizon == 300
    assert dict(point.joints) == dict(zip(JOINTS, point.approach[-1].tolist(), strict=True))
    for camera, stack in found.pictures(point).items():
        np.testing.assert_array_equal(stack, shown["b"][camera])
    assert [p.id for p in read_points(tmp_path / "points", ["b"]).points] == ["b"]
    with pytest.raises(ScenarioError, match="has no point 'c'; it has a, b"):
        read_points(tmp_path / "points", ["c"])


def test_what_puts_a_robot_back_decides_the_hash():
    one = made_point("a")
    for change in ({"joints": 1.0}, {"calibration_sha256": "ab" * 32}, {"picture": 7}):
        assert made_point("a", **change).sha256() != one.sha256()
    assert made_point("a", dataset="elsewhere").sha256() == one.sha256()


def test_pictures_of_another_recording_are_refused(tmp_path):
    write_points(tmp_path / "points", [made_point("a", seed=0)], {"a": pictures_of(5)})
    found = read_points(tmp_path / "points")
    with pytest.raises(ScenarioError, match="camera 'top' at point a is not the one that was recorded"):
        found.pictures(found.points[0])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"joints": []}, "0 joints, not 1 to 64"),
        ({"approach": [[0.0]]}, "field approach: shape"),
        ({"approach": [[9.0] * 6]}, "is not the point's own joints"),
        ({"fps": 0.0}, "cannot be used"),
        ({"quasi_static": "yes"}, "field quasi_static: 'yes' is not true or false"),
        ({"pictures": None}, "not what `roborecover robot points` writes"),
    ],
)
def test_a_damaged_point_is_refused_by_field(change, words):
    scenario = made_point("a")
    start, notes = scenario.reset.options["robot"], scenario.provenance["robot"]
    options = {"robot": {**start, **{k: v for k, v in change.items() if k in start}}}
    provenance = {"robot": {**notes, **{k: v for k, v in change.items() if k in notes}}}
    damaged = replace(scenario, reset=replace(scenario.reset, options=options), provenance=provenance)
    with pytest.raises(ScenarioError, match=words) as err:
        point_of(damaged)
    assert str(err.value).startswith("point a: ")
    assert "\n" not in str(err.value)


def test_a_robot_is_a_platform_by_name_alone():
    assert platform_named("robot").name == "robot"
    assert "robot" not in platform_names()
    with pytest.raises(SimulatorError, match="roborecover robot run"):
        platform_named("robot").make_simulator()
    assert "so101_follower" in describe(made_point("a"))


def test_the_card_of_a_set_of_points_names_the_commands_of_robots(tmp_path):
    root = write_points(tmp_path / "points", [made_point("a")], {"a": pictures_of(0)})
    card = make_card(root, "me/points", license="mit", version="1.0.0", tag="v1.0.0")
    text = card.files["README.md"].decode()
    assert "roborecover robot restore --points=POINTS" in text
    assert "lerobot-eval" not in text
    assert "eval.yaml" not in card.files
