"""What lies under the annotation server: votes on disk, plots, suggestions, example frames, bad datasets."""

from __future__ import annotations

import json
import os
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from lerobot_roborecover.curation.annotation import examples
from lerobot_roborecover.curation.annotation.frames import FramePacks, Videos
from lerobot_roborecover.curation.annotation.guide import SLUGS, slug
from lerobot_roborecover.curation.annotation.naming import body_labels, camera_labels, hand_label
from lerobot_roborecover.curation.annotation.traces import action_labels, suggest, traces
from lerobot_roborecover.curation.annotation.votes import Vote, VoteJournal, votes_folder
from lerobot_roborecover.curation.candidates import read_candidates
from lerobot_roborecover.platforms import SimulatorError
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.journal import Journal, read_journal
from tests.support.candidate_files import CAMERAS, STEPS, candidate_dataset, rollout


def test_a_journal_survives_a_cut_off_line_and_admits_one_writer(tmp_path):
    path = tmp_path / "ann.jsonl"
    book = VoteJournal(tmp_path, "ann", 1)
    book.add(Vote("uid-00000001", "ep-0000", "discard", reason="stuck"))
    with pytest.raises(ScenarioError, match="in use by another process"):
        VoteJournal(tmp_path, "ann", 1)
    book.close()
    whole = path.read_bytes()
    path.write_bytes(whole + whole[: len(whole) // 2])
    with VoteJournal(tmp_path, "ann", 1)._journal as journal:
        assert [r["uid"] for r in journal.records] == ["uid-00000001"]
    assert path.read_bytes() == whole
    path.write_bytes(b"{\n" + whole)
    with pytest.raises(ScenarioError, match="line 1: not a JSON record"):
        VoteJournal(tmp_path, "ann", 1)


def test_a_full_disk_loses_the_vote_in_hand_and_no_other(tmp_path, monkeypatch):
    path = tmp_path / "j.jsonl"
    with Journal(path, 1) as journal:
        journal.append({"n": 1})
        good = path.read_bytes()

        def half(number: int, data: bytes) -> int:
            monkeypatch.undo()
            os.write(number, data[:5])
            raise OSError("No space left on device")

        monkeypatch.setattr("lerobot_roborecover.utils.journal.os.write", half)
        with pytest.raises(ScenarioError, match="could not be written: No space left"):
            journal.append({"n": 2})
        assert path.read_bytes() == good
        journal.append({"n": 3})
    assert [r["n"] for r in read_journal(path, 1)] == [1, 3]


def test_traces_and_suggestions_follow_the_bodies():
    actions, steps = rollout(0)
    found = traces("fake", actions, steps, 20)
    eef = steps.bodies["eef"][:, :3]
    assert found.eef_speed_m_s == pytest.approx(np.linalg.norm(np.diff(eef, axis=0), axis=1) * 20)
    assert list(found.actions) == ["a0", "a1"]
    assert list(traces("metaworld", np.zeros((STEPS, 4)), steps, 80).gripper) == ["a3"]
    # The puck is shoved from step 10 to 15, the end effector stays from step 20 on.
    place = np.zeros((STEPS + 1, 7))
    puck, eef = place.copy(), place.copy()
    puck[:, 0] = np.clip(np.arange(STEPS + 1) - 10, 0, 5) * 0.01
    eef[:, 1] = np.clip(20 - np.arange(STEPS + 1), 0, 20) * 0.05
    perturbed = replace(steps, bodies={"eef": eef, "puck": puck[::-1]})
    assert list(traces("fake", actions, perturbed, 20).object_speed_m_s) == ["puck"]
    assert not traces("fake", actions, perturbed, 20, settle_steps=36).object_speed_m_s
    found = suggest(replace(steps, bodies={"eef": eef, "puck": puck}), 20, 3)
    assert [(s.step, s.by) for s in found] == [(15, "rule"), (20, "rule")]


def test_bodies_cameras_and_actions_have_names_for_people():
    found = body_labels([
        "akita_black_bowl_1_main", "akita_black_bowl_2_main", "plate_1_main", "flat_stove_1_button",
        "wooden_cabinet_1_cabinet_top", "RoundNut", "block1", "obj", "7", "hand", "dial.12",
    ])  # fmt: skip
    assert list(found.values()) == [
        "black bowl 1", "black bowl 2", "plate", "stove button", "cabinet top", "round nut", "block 1",
        "object", "object 7", "object hand", "dial 12",
    ]  # fmt: skip
    assert list(body_labels(["obj", "object"]).values()) == ["object (obj)", "object (object)"]
    images = "observation.images."
    for cameras, names in (
        (("image", "image2"), ["front camera", "wrist camera"]),
        (("head_camera", "left_camera"), ["head camera", "left wrist camera"]),
        (("top", "wrist"), ["top camera", "wrist camera"]),
        (("wrist_image", "image2"), ["wrist camera (wrist_image)", "wrist camera (image2)"]),
    ):
        assert list(camera_labels([images + name for name in cameras]).values()) == names
    assert camera_labels(["observation.image"]) == {"observation.image": "camera"}
    assert [hand_label(name) for name in ("eef", "eef_left")] == ["hand", "left hand"]
    assert list(action_labels("libero", 7).values())[3:] == ["roll", "pitch", "yaw", "gripper"]
    assert list(action_labels("nowhere", 2).values()) == ["action 1", "action 2"]


@pytest.mark.metaworld
@pytest.mark.render
def test_example_frames_come_from_the_shipped_scenarios(tmp_path, monkeypatch):
    def nowhere(**_options):
        raise SimulatorError("no assets")

    monkeypatch.setattr("lerobot_roborecover.platforms.libero.assets.find_assets", nowhere)
    chosen = examples.choose("metaworld")
    assert set(chosen) < set(SLUGS)
    assert all(slug(s.stage, s.deviation) == name for name, s in chosen.items())
    one = {"move-wrong-pose": chosen["move-wrong-pose"]}
    monkeypatch.setattr(examples, "choose", lambda platform: one)
    examples.render("metaworld", tmp_path)
    with Image.open(tmp_path / "move-wrong-pose.jpg") as picture:
        assert picture.size == (320, 320)
        assert np.asarray(picture).std() > 10
    assert [p.name for p in tmp_path.iterdir()] == ["move-wrong-pose.jpg"]


def test_a_damaged_video_is_one_answer_and_no_crash(tmp_path):
    root = candidate_dataset(tmp_path / "set", 1)
    (root / "videos" / CAMERAS[0] / "chunk-000/file-000.mp4").write_bytes(b"no video")
    with pytest.raises(ScenarioError, match=r"file-000.mp4 cannot be decoded"):
        FramePacks(Videos(root), [STEPS]).pack(CAMERAS[0], 0, 0)
    outside = tmp_path / "outside.mp4"
    (root / "videos" / CAMERAS[1] / "chunk-000/file-000.mp4").rename(outside)
    (root / "videos" / CAMERAS[1] / "chunk-000/file-000.mp4").symlink_to(outside)
    with pytest.raises(ScenarioError, match="not a video file inside the dataset"):
        Videos(root).decode(CAMERAS[1], 0, 0, 1)


def test_a_dataset_of_something_else_is_refused(tmp_path):
    (tmp_path / "meta").mkdir()
    with pytest.raises(ScenarioError, match="is not a candidate dataset"):
        read_candidates(tmp_path)
    root = candidate_dataset(tmp_path / "set", 2)
    path = root / "meta/roborecover/candidates.json"
    good = json.loads(path.read_text())
    for change, said in (
        ({"schema_version": 2}, "from the future"),
        ({"candidates": good["candidates"][:1]}, "1 candidates, but 2 rollouts"),
        ({"candidates": [good["candidates"][0]] * 2}, "ids are unique"),
        ({"candidates": [{**c, "id": "../x"} for c in good["candidates"]]}, "candidate id '../x'"),
        ({"candidates": None}, "not what write_candidates writes"),
    ):
        path.write_text(json.dumps({**good, **change}))
        with pytest.raises(ScenarioError, match=said):
            read_candidates(root)
    path.write_text(json.dumps(good))
    found = read_candidates(root)
    (root / "meta/roborecover/steps.parquet").write_bytes(b"PAR1")
    with pytest.raises(ScenarioError, match=r"steps.parquet: row 0 is not what"):
        found.steps(0)
    assert votes_folder(root, None) == root / "meta/roborecover/votes"
