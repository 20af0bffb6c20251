"""The annotation server: who may ask for what, frames that are the right ones, votes that are never lost."""

from __future__ import annotations

import io
import json
import re
import shutil
import struct
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from lerobot_roborecover.curation.annotation.discussion import Discussion
from lerobot_roborecover.curation.annotation.frames import PACK
from lerobot_roborecover.curation.annotation.guide import CELLS, SLUGS
from lerobot_roborecover.curation.annotation.votes import Vote, ballot
from lerobot_roborecover.curation.candidates import read_candidates
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.journal import read_journal
from lerobot_roborecover.web.annotate.identity import names_of, queue_order
from lerobot_roborecover.web.annotate.serve import AnnotateConfig, serve
from lerobot_roborecover.web.guard import MAX_BODY_BYTES, cookie_name
from lerobot_roborecover.web.serve import kept_tokens
from tests.support.annotation_server import TOKENS, serving
from tests.support.candidate_files import CAMERAS, STEPS, candidate_dataset, number_of


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    root = candidate_dataset(tmp_path_factory.mktemp("sets") / "rollouts", 7, dropped=(6,))
    folder = root / "meta/roborecover/examples"
    folder.mkdir()
    Image.new("RGB", (8, 8), "red").save(folder / f"{SLUGS[0]}.png")
    return root


@pytest.fixture(scope="module")
def quiet(dataset, tmp_path_factory):
    """Clients of a server that no test gives a vote that it takes; and its folder of votes."""
    folder = tmp_path_factory.mktemp("votes")
    with serving(read_candidates(dataset), folder) as clients:
        yield clients, folder


@pytest.fixture
def annotators(dataset, tmp_path):
    with serving(read_candidates(dataset), tmp_path) as clients:
        yield clients


# -- who may ask ---------------------------------------------------------------------------------------------

ALL = ("", "app.js", "api/session", "api/episodes/EPISODE", f"api/episodes/EPISODE/frames/{CAMERAS[0]}/0",
       "api/examples", f"api/examples/{SLUGS[0]}")  # fmt: skip


@pytest.mark.parametrize("path", ALL)
def test_every_request_needs_its_host_and_its_token(quiet, path):
    ann = quiet[0]["ann"]
    path = path.replace("EPISODE", ann.episode("ep-0000"))
    assert ann.get(path).status_code == 200
    assert ann.get(path, headers={"Host": "attacker.example"}).status_code == 421
    assert ann.get(path, headers={"Host": "127.0.0.1:9999"}).status_code == 421
    for token in ("", "a" * 31, TOKENS["bob"]):
        wrong = {"Cookie": f"{cookie_name('ann', TOKENS['ann'])}={token}"}
        assert ann.get(path, headers=wrong).status_code == 403


@pytest.mark.parametrize("path", ["api/votes", "api/undo", "api/reveal", "api/adopt"])
def test_changes_must_come_from_the_page(quiet, path):
    ann = quiet[0]["ann"]
    body = json.dumps(ann.vote())
    kind = {"Content-Type": "application/json"}
    assert (
        ann.post(path, content=body, headers=kind | {"Origin": "http://attacker.example"}).status_code == 403
    )
    assert ann.post(path, content=body, headers={"Content-Type": "text/plain"}).status_code == 415
    assert ann.post(path, content=b"[" * 2000, headers=kind).status_code == 400
    assert ann.post(path, content=b"[]", headers=kind).status_code == 400
    assert ann.post(path, content=b" " * (MAX_BODY_BYTES + 1), headers=kind).status_code == 413
    assert ann.post(path, content=body, headers=kind | {"Cookie": ""}).status_code == 403
    assert quiet[0]["bob"].get("api/session").json()["latest"] is None


def test_the_token_in_the_address_becomes_a_cookie(quiet):
    ann = quiet[0]["ann"]
    answer = ann.get("", params={"token": TOKENS["ann"]}, headers={"Cookie": ""}, follow_redirects=False)
    assert (answer.status_code, answer.headers["location"]) == (303, "/ann/")
    cookie = answer.headers["set-cookie"]
    assert all(word in cookie for word in ("HttpOnly", "SameSite=strict", "Path=/ann/"))
    page = ann.get("")
    assert page.status_code == 200
    assert "script-src 'self'" in page.headers["content-security-policy"]
    assert TOKENS["ann"] not in page.text


@pytest.mark.parametrize(
    "path",
    [
        "/ann/../bob/api/session", "/ann/%2e%2e/%2e%2e/etc/passwd", "/ann/..%2f..%2fetc%2fpasswd",
        "/ann/page", "/ann/server.py",
        "/ann/api/examples/..%2f..%2fcandidates.json", "/ann/api/examples/nothing",
        f"/ann/api/episodes/..%2fEPISODE/frames/{CAMERAS[0]}/0",
        "/ann/api/episodes/EPISODE/frames/..%2f..%2fdata/0",
        "/ann/api/episodes/ep-0000", "/ann/api/episodes/DROPPED", "/ann/api/episodes/ep-9999",
        "/nobody/api/session", "/", "/ann",
    ],
)  # fmt: skip
def test_paths_lead_nowhere_else(quiet, path):
    """Also an episode that a stage before has dropped is not shown."""
    ann = quiet[0]["ann"]
    path = path.replace("EPISODE", ann.episode("ep-0000")).replace("DROPPED", ann.episode("ep-0006"))
    answer = ann.get(ann.base_url.copy_with(raw_path=path.encode()))
    assert answer.status_code in (403, 404)
    assert b"root:" not in answer.content


@pytest.mark.parametrize("path", ["/", "/ann", "/ann/", "/bob/?token=wrong", "/ann/nothing"])
def test_a_person_without_a_token_reads_what_to_do(quiet, path):
    ann = quiet[0]["ann"]
    url = ann.base_url.copy_with(raw_path=path.encode())
    answer = ann.get(url, headers={"Accept": "text/html,*/*;q=0.8", "Cookie": ""})
    assert answer.status_code in (403, 404)
    assert answer.headers["content-type"] == "text/html; charset=utf-8"
    policy = answer.headers["content-security-policy"]
    assert "style-src 'sha256-" in policy
    assert "form-action 'none'" in policy
    assert "?token=" in answer.text
    assert "bob" not in answer.text
    other = ann.get(url, headers={"Accept": "text/html", "Host": "<b>.example"})
    assert (other.status_code, "<b>" in other.text) == (421, False)


# -- what is shown -------------------------------------------------------------------------------------------


def frames_of(pack: bytes) -> list[np.ndarray]:
    count = struct.unpack("<I", pack[:4])[0]
    sizes = struct.unpack(f"<{count}I", pack[4 : 4 * (count + 1)])
    found, at = [], 4 * (count + 1)
    for size in sizes:
        found.append(np.asarray(Image.open(io.BytesIO(pack[at : at + size]))))
        at += size
    assert at == len(pack)
    return found


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("episode", [0, 2, 4])
def test_packs_hold_the_very_frames(quiet, episode, camera):
    ann = quiet[0]["ann"]
    name = ann.episode(f"ep-{episode:04d}")
    packs = [frames_of(ann.get(f"api/episodes/{name}/frames/{camera}/{n}").content) for n in (0, 1)]
    assert [len(p) for p in packs] == [PACK, STEPS - PACK]
    assert [number_of(f) for pack in packs for f in pack] == [(n, episode % 3) for n in range(STEPS)]


@pytest.mark.parametrize("number", [2, 10**9, -1, "9" * 5000, "\u0662", "1e0"])
def test_a_frame_out_of_range_is_refused(quiet, number):
    ann = quiet[0]["ann"]
    answer = ann.get(f"api/episodes/{ann.episode('ep-0000')}/frames/{CAMERAS[0]}/{number}")
    assert answer.status_code in (404, 416)


def test_annotators_are_blind_to_each_other_and_to_who_drove(annotators):
    ann, bob = annotators["ann"], annotators["bob"]
    before = bob.get("api/session").json()
    assert ann.post("api/votes", json=ann.vote(comment="mine")).status_code == 200
    assert bob.get("api/session").json() == before
    assert "noise" not in ann.get(f"api/episodes/{ann.episode('ep-0000')}").text
    orders = [[item["id"] for item in c.get("api/session").json()["queue"]] for c in (ann, bob)]
    assert orders[0] != orders[1]
    assert sorted(orders[0]) == sorted(orders[1]) == sorted(ann.episode(f"ep-000{i}") for i in range(6))
    assert queue_order(["a", "b", "c"], "ann", 0) == queue_order(["c", "b", "a"], "ann", 0)


def test_nothing_that_an_annotator_receives_tells_ids_drivers_or_folders(dataset, tmp_path, capfd):
    """Ids and folders' names name the controller and what was perturbed, errors included."""
    root = tmp_path / "scripted-perturbed"
    shutil.copytree(dataset, root)
    candidates = read_candidates(root)
    said = Vote("uid-00000009", "ep-0001", "discard", reason="stuck", annotator="bob")
    listed = Discussion.of(2, {f"ep-000{i}": ("no majority: stage", [said]) for i in range(6)})
    with serving(candidates, tmp_path / "votes", ("ann",), listed) as clients:
        ann = clients["ann"]
        # Damaged after the start, which would have refused it.
        (root / f"videos/{CAMERAS[1]}/chunk-000/file-000.mp4").write_bytes(b"no video")
        answers = [ann.get(path) for path in ("", "app.js", "api/session", "api/examples", "api/examples/x")]
        for item in ann.get("api/session").json()["queue"]:
            name = item["id"]
            answers.append(ann.post("api/votes", json=ann.vote(uid=f"uid-{name}", candidate=name, step=9)))
            answers += [ann.get(f"api/episodes/{name}"), ann.post("api/reveal", json={"candidate": name})]
            answers.append(ann.get(f"api/episodes/{name}/frames/{CAMERAS[1]}/0"))
        answers += [ann.get("api/session"), ann.post("api/undo", json={"uid": f"uid-{name}"})]
        assert answers[-3].status_code == 500
    for answer in answers:
        whole = answer.text + str(answer.url) + str(answer.headers)
        assert not [word for word in ("ep-0", "scripted", "noise", str(tmp_path)) if word in whole], whole
    # The server's operator is told which one it is.
    assert f"episode {name} ({ann.called.candidates[name]}): {root}" in capfd.readouterr().err
    journal = read_journal(tmp_path / "votes/ann.jsonl", 1)
    assert {r["candidate"] for r in journal if r["kind"] == "vote"} == {f"ep-000{i}" for i in range(6)}


def test_names_are_the_same_at_every_start_and_tell_rollouts_apart(dataset, tmp_path):
    candidates = read_candidates(dataset)
    called = names_of(candidates, tmp_path / "votes")
    assert called == names_of(read_candidates(dataset), tmp_path / "votes")
    assert sorted(called.candidates[name] for name in called.episodes.values()) == sorted(candidates.by_id)
    assert all(re.fullmatch("[0-9a-f]{12}", name) for name in called.episodes.values())
    # The same rollouts with other votes are another dataset; one that has grown is the same.
    copy = names_of(candidates, tmp_path / "other")
    assert (copy.dataset == called.dataset, copy.episodes == called.episodes) == (False, True)
    fewer = replace(
        candidates,
        candidates=candidates.candidates[:3],
        trajectories=replace(candidates.trajectories, rows=candidates.trajectories.rows[:3]),
    )
    assert names_of(fewer, tmp_path / "votes").dataset == called.dataset
    # The same ids on other rollouts.
    turned = replace(candidates, candidates=candidates.candidates[2:] + candidates.candidates[:2])
    assert not set(names_of(turned, tmp_path / "votes").episodes.values()) & set(called.candidates)


def test_suggestions_are_blind_until_voted_and_leave_a_trace(annotators, tmp_path):
    ann = annotators["ann"]
    assert ann.post("api/reveal", json={"candidate": ann.episode("ep-0000")}).status_code == 409
    assert ann.get(f"api/episodes/{ann.episode('ep-0000')}").json()["suggestions"] is None
    ann.post("api/votes", json=ann.vote())
    assert ann.get(f"api/episodes/{ann.episode('ep-0000')}").json()["suggestions"] is None
    shown = ann.post("api/reveal", json={"candidate": ann.episode("ep-0000")}).json()["suggestions"]
    assert {"step": 17, "text": "Contact Wrong Pose the arm stops", "by": "model"} in shown
    assert any(s["by"] == "rule" for s in shown)
    ann.post("api/votes", json=ann.vote(uid="uid-00000002", step=17))
    found = ballot(read_journal(tmp_path / "ann.jsonl", 1), 1)
    assert (found.votes["ep-0000"].step, found.votes["ep-0000"].informed) == (17, True)
    assert found.blind["ep-0000"].step == 20


def test_a_discussion_shows_the_votes_without_names(dataset, tmp_path):
    said = Vote("uid-00000009", "ep-0001", "discard", reason="stuck", annotator="bob")
    listed = Discussion.of(2, {"ep-0001": ("no majority: stage", [said])})
    with serving(read_candidates(dataset), tmp_path, ("ann",), listed) as clients:
        ann = clients["ann"]
        text = ann.get(f"api/episodes/{ann.episode('ep-0001')}").text
        assert "no majority: stage" in text
        assert "bob" not in text
        assert ann.post("api/votes", json=ann.vote("ep-0001", step=9)).status_code == 200
    assert read_journal(tmp_path / "ann.jsonl", 1)[0]["round"] == 2


# -- votes ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "status", "said"),
    [
        ({"candidate": "ep-9999"}, 404, "no episode"),
        ({"candidate": "ep-0000"}, 404, "no episode"),
        ({"of": "ep-0006"}, 404, "no episode"),
        ({"candidate": ["ep-0000"]}, 404, "no episode"),
        ({"dataset": "0123456789abcdef"}, 409, "about dataset '0123456789abcdef', and this server has"),
        ({"dataset": None}, 409, "field dataset"),
        ({"step": STEPS}, 422, "a step from 3 to 44"),
        ({"step": 2}, 422, "a step from 3 to 44"),
        ({"step": -1}, 422, "field step"),
        ({"step": 20.0}, 422, "field step"),
        ({"step": True}, 422, "field step"),
        ({"step": None}, 422, "field step"),
        ({"stage": "Dance"}, 422, "one of Approach, Contact, Move, Place"),
        ({"deviation": ["Wrong Pose"]}, 422, "field deviation"),
        ({"verdict": "maybe"}, 422, "field verdict"),
        ({"verdict": "discard"}, 422, "field reason"),
        ({"verdict": "discard", "reason": "stuck"}, 422, "empty where it is discarded"),
        ({"verdict": "discard", "reason": "other", "stage": "", "deviation": ""}, 422, "the reason in words"),
        ({"verdict": "discard", "reason": "temporary", "stage": "", "deviation": "", "of": "ep-0004"},
         422, "proves that it can be recovered"),
        ({"comment": "x" * 2001}, 422, "at most 2000"),
        ({"comment": "\ud800"}, 422, "field comment"),
        ({"uid": "../../x"}, 422, "field uid"),
        ({"seconds": float("nan")}, 422, "field seconds"),
        ({"annotator": "bob"}, 422, "a vote is an object"),
    ],
)  # fmt: skip
def test_a_vote_that_cannot_be_is_refused_and_not_kept(quiet, changes, status, said):
    clients, folder = quiet
    ann = clients["ann"]
    body = json.dumps(ann.vote(**changes))
    answer = ann.post("api/votes", content=body, headers={"Content-Type": "application/json"})
    assert (answer.status_code, said in answer.json()["error"]) == (status, True), answer.text
    assert (folder / "ann.jsonl").read_bytes() == b""


def test_a_vote_is_on_disk_when_it_is_answered_and_counts_once(annotators, tmp_path):
    ann = annotators["ann"]
    body = ann.vote(comment="<script>alert(1)</script>")
    for _ in range(2):
        assert ann.post("api/votes", json=body).json()["vote"]["step"] == 20
    records = read_journal(tmp_path / "ann.jsonl", 1)
    assert [(r["kind"], r["uid"], r["annotator"], r["round"]) for r in records] == [
        ("vote", "uid-00000001", "ann", 1)
    ]
    assert ann.get(f"api/episodes/{ann.episode('ep-0000')}").json()["vote"]["comment"] == body["comment"]
    assert ann.get(f"api/episodes/{ann.episode('ep-0000')}").headers["content-type"] == "application/json"


def test_two_servers_of_one_name_take_only_their_own_votes_and_cookies(dataset, tmp_path, monkeypatch):
    """Two datasets in folders of the same base name with the same ids, and one annotator with a browser."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    answers = {}
    tokens = kept_tokens("annotate", tmp_path / "a/candidates", ["ann"]), {"ann": TOKENS["ann"]}
    assert cookie_name("ann", tokens[0]["ann"]) != cookie_name("ann", tokens[1]["ann"])
    for place in ("a", "b"):
        (tmp_path / place).mkdir(exist_ok=True)
        shutil.copytree(dataset, tmp_path / place / "candidates")
        candidates = read_candidates(tmp_path / place / "candidates")
        with serving(candidates, tmp_path / place / "votes", ("ann",)) as clients:
            ann = clients["ann"]
            answers[place] = ann.vote()
            if place == "b":
                refused = ann.post("api/votes", json=answers["a"])
                assert refused.status_code == 409
                assert answers["a"]["dataset"] in refused.text
                assert answers["b"]["dataset"] in refused.text
                adopting = {"dataset": answers["a"]["dataset"], "candidates": ["ep-0000"]}
                assert ann.post("api/adopt", json=adopting).status_code == 409
    assert read_journal(tmp_path / "b/votes/ann.jsonl", 1) == []


def test_ids_that_an_earlier_page_has_kept_are_found_only_in_the_own_queue(quiet):
    ann = quiet[0]["ann"]
    asked = {"dataset": ann.called.dataset, "candidates": ["ep-0001", "ep-0006", "ep-9999", 7]}
    said = ann.post("api/adopt", json=asked).json()
    assert said == {"episodes": {"ep-0001": ann.episode("ep-0001")}}
    assert ann.post("api/adopt", json={**asked, "candidates": ["x"] * 101}).status_code == 422


def test_undo_takes_back_the_latest_and_brings_back_the_one_before(annotators):
    ann = annotators["ann"]
    ann.post("api/votes", json=ann.vote())
    ann.post("api/votes", json=ann.vote(uid="uid-00000002", step=30))
    assert ann.post("api/undo", json={"uid": "uid-00000001"}).status_code == 409
    said = ann.post("api/undo", json={"uid": "uid-00000002"}).json()
    assert (said["undone"]["step"], said["vote"]["step"], said["latest"]) == (30, 20, "uid-00000001")
    assert ann.post("api/undo", json={"uid": "uid-00000002"}).status_code == 409
    # A vote that was taken back and arrives once more, because its answer was lost, stays taken back.
    ann.post("api/votes", json=ann.vote(uid="uid-00000002", step=30))
    assert ann.get(f"api/episodes/{ann.episode('ep-0000')}").json()["vote"]["step"] == 20


# -- what is plotted, and the guide --------------------------------------------------------------------------


def test_the_guide_has_the_nine_cells_and_the_dataset_s_own_pictures(quiet):
    guide = quiet[0]["ann"].get("api/session").json()["guide"]
    assert len(guide["cells"]) == len(CELLS) == 9
    keys = [item["key"] for item in guide["stages"] + guide["types"]]
    assert keys == ["a", "c", "m", "p", "1", "2", "3", "4"]
    assert quiet[0]["ann"].get(f"api/examples/{SLUGS[0]}").headers["content-type"] == "image/png"
    assert quiet[0]["ann"].get(f"api/examples/{SLUGS[1]}").status_code == 404


# -- starting ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"annotators": ["../ann"]}, "is not 1 to 32 of a-z"),
        ({"annotators": ["ann", "ann"]}, "named twice"),
        ({"port": 99999}, "99999 cannot be served"),
    ],
)
def test_a_session_that_cannot_be_is_refused(dataset, tmp_path, changes, said):
    config = AnnotateConfig(dataset, ["ann"], port=0, votes=tmp_path, examples=False)
    with pytest.raises(ScenarioError, match=said):
        serve(replace(config, **changes), print)
