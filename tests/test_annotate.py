"""The annotation server: who may ask for what, frames that are the right ones, votes that are never lost."""

from __future__ import annotations

import io
import json
import struct
import threading
from contextlib import contextmanager
from dataclasses import replace

import httpx
import numpy as np
import pytest
import uvicorn
from candidate_files import CAMERAS, STEPS, candidate_dataset, number_of
from PIL import Image

from lerobot_roborecover.build.annotate.discussion import Discussion
from lerobot_roborecover.build.annotate.examples import Examples
from lerobot_roborecover.build.annotate.frames import PACK, FrameStore, Videos
from lerobot_roborecover.build.annotate.guide import CELLS, SLUGS
from lerobot_roborecover.build.annotate.queue import queue_order
from lerobot_roborecover.build.annotate.serve import AnnotateConfig, serve
from lerobot_roborecover.build.annotate.server import Desk, Study, make_app
from lerobot_roborecover.build.annotate.votes import Vote, VoteBook, ballot
from lerobot_roborecover.build.candidates import read_candidates
from lerobot_roborecover.build.journal import read_journal
from lerobot_roborecover.build.resolution import queued
from lerobot_roborecover.build.web.guard import MAX_BODY_BYTES
from lerobot_roborecover.build.web.serve import listen
from lerobot_roborecover.scenario import ScenarioError

TOKENS = {"ann": "a" * 32, "bob": "b" * 32}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    root = candidate_dataset(tmp_path_factory.mktemp("sets") / "rollouts", 7, dropped=(6,))
    folder = root / "meta/roborecover/examples"
    folder.mkdir()
    Image.new("RGB", (8, 8), "red").save(folder / f"{SLUGS[0]}.png")
    return root


@contextmanager
def serving(candidates, folder, names=("ann", "bob"), discussion=None):
    """A server on a port of its own; yields a client of each annotator, with the token as its cookie."""
    root = candidates.root
    store = FrameStore(Videos(root), [row.steps for row in candidates.trajectories.rows])
    queue = sorted(discussion.candidates if discussion else queued(candidates))
    rounds = discussion.round if discussion else 1
    desks = {n: Desk(TOKENS[n], VoteBook(folder, n, rounds), queue_order(queue, n, 0)) for n in names}
    listener = listen(0)
    host = f"127.0.0.1:{listener.getsockname()[1]}"
    pictures = Examples(root, "fake", render=False)
    app = make_app(Study(candidates, store, pictures, desks, frozenset({host}), discussion))
    server = uvicorn.Server(uvicorn.Config(app, log_level="critical", lifespan="off"))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        yield {
            n: httpx.Client(
                base_url=f"http://{host}/{n}/",
                headers={"Cookie": f"roborecover_{n}={TOKENS[n]}"},
                trust_env=False,
            )
            for n in names
        }
    finally:
        server.should_exit = True
        thread.join()
        listener.close()
        store.close()
        for desk in desks.values():
            desk.book.close()


@pytest.fixture(scope="module")
def quiet(dataset, tmp_path_factory):
    """Clients of a server that no test gives a vote that it takes; and its folder of votes."""
    folder = tmp_path_factory.mktemp("votes")
    with serving(read_candidates(dataset), folder) as clients:
        yield clients, folder


@pytest.fixture
def desks(dataset, tmp_path):
    with serving(read_candidates(dataset), tmp_path) as clients:
        yield clients


def vote(candidate: str = "ep-0000", **changes) -> dict:
    base = {"uid": "uid-00000001", "candidate": candidate, "verdict": "recovery", "step": 20}
    return {**base, "stage": "Move", "deviation": "Wrong Pose", "comment": "", "seconds": 3, **changes}


# -- who may ask ---------------------------------------------------------------------------------------------

ALL = ("", "app.js", "api/session", "api/episodes/ep-0000", f"api/episodes/ep-0000/frames/{CAMERAS[0]}/0",
       f"api/examples/{SLUGS[0]}")  # fmt: skip


@pytest.mark.parametrize("path", ALL)
def test_every_request_needs_its_host_and_its_token(quiet, path):
    ann = quiet[0]["ann"]
    assert ann.get(path).status_code == 200
    assert ann.get(path, headers={"Host": "attacker.example"}).status_code == 421
    assert ann.get(path, headers={"Host": "127.0.0.1:9999"}).status_code == 421
    for token in ("", "a" * 31, TOKENS["bob"]):
        assert ann.get(path, headers={"Cookie": f"roborecover_ann={token}"}).status_code == 403


@pytest.mark.parametrize("path", ["api/votes", "api/undo", "api/reveal"])
def test_changes_must_come_from_the_page(quiet, path):
    ann = quiet[0]["ann"]
    body = json.dumps(vote())
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
        f"/ann/api/episodes/..%2fep-0000/frames/{CAMERAS[0]}/0",
        "/ann/api/episodes/ep-0000/frames/..%2f..%2fdata/0",
        "/ann/api/episodes/ep-0006", "/ann/api/episodes/ep-9999", "/nobody/api/session", "/", "/ann",
    ],
)  # fmt: skip
def test_paths_lead_nowhere_else(quiet, path):
    """Also an episode that a stage before has dropped is not shown."""
    ann = quiet[0]["ann"]
    answer = ann.get(ann.base_url.copy_with(raw_path=path.encode()))
    assert answer.status_code in (403, 404)
    assert b"root:" not in answer.content


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
    packs = [
        frames_of(quiet[0]["ann"].get(f"api/episodes/ep-{episode:04d}/frames/{camera}/{n}").content)
        for n in (0, 1)
    ]
    assert [len(p) for p in packs] == [PACK, STEPS - PACK]
    assert [number_of(f) for pack in packs for f in pack] == [(n, episode % 3) for n in range(STEPS)]


@pytest.mark.parametrize("number", [2, 10**9, -1])
def test_a_frame_out_of_range_is_refused(quiet, number):
    answer = quiet[0]["ann"].get(f"api/episodes/ep-0000/frames/{CAMERAS[0]}/{number}")
    assert answer.status_code in (404, 416)


def test_annotators_are_blind_to_each_other_and_to_who_drove(desks):
    ann, bob = desks["ann"], desks["bob"]
    before = bob.get("api/session").json()
    assert ann.post("api/votes", json=vote(comment="mine")).status_code == 200
    assert bob.get("api/session").json() == before
    assert "noise" not in ann.get("api/episodes/ep-0000").text
    orders = [[item["id"] for item in c.get("api/session").json()["queue"]] for c in (ann, bob)]
    assert orders[0] != orders[1]
    assert sorted(orders[0]) == sorted(orders[1]) == [f"ep-000{i}" for i in range(6)]
    assert queue_order(["a", "b", "c"], "ann", 0) == queue_order(["c", "b", "a"], "ann", 0)


def test_suggestions_are_blind_until_voted_and_leave_a_trace(desks, tmp_path):
    ann = desks["ann"]
    assert ann.post("api/reveal", json={"candidate": "ep-0000"}).status_code == 409
    assert ann.get("api/episodes/ep-0000").json()["suggestions"] is None
    ann.post("api/votes", json=vote())
    assert ann.get("api/episodes/ep-0000").json()["suggestions"] is None
    shown = ann.post("api/reveal", json={"candidate": "ep-0000"}).json()["suggestions"]
    assert {"step": 17, "text": "Contact Wrong Pose the arm stops", "by": "model"} in shown
    assert any(s["by"] == "rule" for s in shown)
    ann.post("api/votes", json=vote(uid="uid-00000002", step=17))
    found = ballot(read_journal(tmp_path / "ann.jsonl", 1), 1)
    assert (found.votes["ep-0000"].step, found.votes["ep-0000"].informed) == (17, True)
    assert found.blind["ep-0000"].step == 20


def test_a_discussion_shows_the_votes_without_names(dataset, tmp_path):
    said = Vote("uid-00000009", "ep-0001", "discard", reason="stuck", annotator="bob")
    listed = Discussion.of(2, {"ep-0001": ("no majority: stage", [said])})
    with serving(read_candidates(dataset), tmp_path, ("ann",), listed) as clients:
        text = clients["ann"].get("api/episodes/ep-0001").text
        assert "no majority: stage" in text
        assert "bob" not in text
        assert clients["ann"].post("api/votes", json=vote("ep-0001", step=9)).status_code == 200
    assert read_journal(tmp_path / "ann.jsonl", 1)[0]["round"] == 2


# -- votes ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "status", "said"),
    [
        ({"candidate": "ep-9999"}, 404, "no episode"),
        ({"candidate": "ep-0006"}, 404, "no episode"),
        ({"candidate": ["ep-0000"]}, 404, "no episode"),
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
        ({"verdict": "discard", "reason": "temporary", "stage": "", "deviation": "", "candidate": "ep-0004"},
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
    body = json.dumps(vote(**changes))
    answer = clients["ann"].post("api/votes", content=body, headers={"Content-Type": "application/json"})
    assert (answer.status_code, said in answer.json()["error"]) == (status, True), answer.text
    assert (folder / "ann.jsonl").read_bytes() == b""


def test_a_vote_is_on_disk_when_it_is_answered_and_counts_once(desks, tmp_path):
    ann = desks["ann"]
    body = vote(comment="<script>alert(1)</script>")
    for _ in range(2):
        assert ann.post("api/votes", json=body).json()["vote"]["step"] == 20
    records = read_journal(tmp_path / "ann.jsonl", 1)
    assert [(r["kind"], r["uid"], r["annotator"], r["round"]) for r in records] == [
        ("vote", "uid-00000001", "ann", 1)
    ]
    assert ann.get("api/episodes/ep-0000").json()["vote"]["comment"] == body["comment"]
    assert ann.get("api/episodes/ep-0000").headers["content-type"] == "application/json"


def test_undo_takes_back_the_latest_and_brings_back_the_one_before(desks):
    ann = desks["ann"]
    ann.post("api/votes", json=vote())
    ann.post("api/votes", json=vote(uid="uid-00000002", step=30))
    assert ann.post("api/undo", json={"uid": "uid-00000001"}).status_code == 409
    said = ann.post("api/undo", json={"uid": "uid-00000002"}).json()
    assert (said["undone"]["step"], said["vote"]["step"], said["latest"]) == (30, 20, "uid-00000001")
    assert ann.post("api/undo", json={"uid": "uid-00000002"}).status_code == 409
    # A vote that was taken back and arrives once more, because its answer was lost, stays taken back.
    ann.post("api/votes", json=vote(uid="uid-00000002", step=30))
    assert ann.get("api/episodes/ep-0000").json()["vote"]["step"] == 20


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
        ({"port": 99999}, "port 99999 cannot be used"),
    ],
)
def test_a_session_that_cannot_be_is_refused(dataset, tmp_path, changes, said):
    config = AnnotateConfig(dataset, ["ann"], port=0, votes=tmp_path, examples=False)
    with pytest.raises(ScenarioError, match=said):
        serve(replace(config, **changes), print)
