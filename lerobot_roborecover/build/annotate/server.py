"""The page's server: every request checked, every answer to one annotator only.

Each annotator has a token and an address of their own, `/NAME/`. The first request carries the token in its
query and gets it as a cookie for that address; every further request, pictures included, must carry the
cookie (`build/web/guard.py`).

Starlette and uvicorn rather than `http.server`: header, cookie and body parsing are what a server gets wrong,
and the same stack carries the live streams of `teleop`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from lerobot_roborecover.build.annotate.discussion import Discussion
from lerobot_roborecover.build.annotate.examples import Examples
from lerobot_roborecover.build.annotate.frames import PACK, FrameStore
from lerobot_roborecover.build.annotate.guide import as_json
from lerobot_roborecover.build.annotate.traces import Place, suggest, traces
from lerobot_roborecover.build.annotate.votes import Vote, VoteBook, VoteError, parse_vote
from lerobot_roborecover.build.candidates import CandidateSet
from lerobot_roborecover.build.web.guard import Refusal, check_token, guarded, read_body, with_cookie
from lerobot_roborecover.build.web.page import PageFiles
from lerobot_roborecover.scenario import ScenarioError, Source

MAX_BODIES_PLOTTED = 4
_PAGE = PageFiles(
    "lerobot_roborecover.build.annotate", "app.js", "drafts.js", "frames.js", "plots.js", "outbox.js",
    "panel.js", "readout.js", "guide.js",
)  # fmt: skip


@dataclass(frozen=True)
class Desk:
    """One annotator at work."""

    token: str
    book: VoteBook
    queue: Sequence[str]
    """Candidate ids in this annotator's order."""


@dataclass(frozen=True)
class Study:
    """Everything that is served."""

    candidates: CandidateSet
    frames: FrameStore
    examples: Examples
    desks: Mapping[str, Desk]
    """By annotator."""
    hosts: frozenset[str]
    """Host headers that name this server."""
    discussion: Discussion | None = None


class Handlers:
    """The answers, once a request has been checked."""

    def __init__(self, study: Study):
        self.study = study

    def desk(self, request: Request) -> Desk:
        """The annotator that a request comes from, as far as it may be answered.

        Raises:
            Refusal: see `guard.check_token`.
        """
        name = request.path_params["annotator"]
        desk = self.study.desks.get(name)
        check_token(request, name, desk and desk.token, "roborecover annotate")
        assert desk is not None
        return desk

    def episode(self, desk: Desk, name: object) -> int:
        """A candidate's episode.

        Raises:
            Refusal: it is not in this annotator's queue.
        """
        if not isinstance(name, str) or name not in desk.queue:
            raise Refusal(404, f"there is no episode {str(name)[:80]!r} in this queue")
        return self.study.candidates.by_id[name]

    async def page(self, request: Request) -> Response:
        """A file of the page; the token in an address is exchanged for a cookie."""
        self.desk(request)
        if "token" in request.query_params:
            return with_cookie(request, request.path_params["annotator"])
        return _PAGE.response(request.path_params.get("file", ""))

    async def session(self, request: Request) -> Response:
        """Who annotates what, how far they are, and the guide."""
        desk, study = self.desk(request), self.study
        ballot = desk.book.ballot()
        return JSONResponse(
            {
                "annotator": desk.book.annotator,
                "dataset": study.candidates.root.name,
                "platform": study.candidates.platform,
                "round": desk.book.round,
                "fps": study.frames.videos.fps,
                "pack": PACK,
                "cameras": study.frames.videos.cameras,
                "queue": [{"id": c, "vote": _vote_json(ballot.votes.get(c))} for c in desk.queue],
                "latest": ballot.order[-1] if ballot.order else None,
                "guide": as_json(),
            }
        )

    async def episode_info(self, request: Request) -> Response:
        """All that is known of an episode and may be shown: not who drove, nor what others marked."""
        desk = self.desk(request)
        name = request.path_params["candidate"]
        number = self.episode(desk, name)
        ahead = desk.queue.index(name) + 1
        self.study.frames.make_ahead(number)
        for following in desk.queue[ahead : ahead + 1]:
            self.study.frames.make_ahead(self.study.candidates.by_id[following])
        return JSONResponse(await run_in_threadpool(self._info, desk, name, number))

    def _info(self, desk: Desk, name: str, number: int) -> dict[str, Any]:
        candidates, fps = self.study.candidates, self.study.frames.videos.fps
        row, candidate = candidates.row(number), candidates.candidates[number]
        steps = candidates.steps(number)
        settled = first_step(candidates, number) - 1
        plotted = traces(candidates.platform, candidates.actions(number), steps, fps, settled)
        objects = dict(list(plotted.object_speed_m_s.items())[:MAX_BODIES_PLOTTED])
        ballot = desk.book.ballot()
        info = {
            "id": name,
            "instruction": row.task["instruction"],
            "task": f"{row.task['suite']} / {row.task['name']}",
            "human": candidate.source is Source.HUMAN,
            "steps": row.steps,
            "first_step": first_step(candidates, number),
            "solved_at_end": bool(steps.solved[-1]),
            "actions": {n: _rounded(v) for n, v in plotted.actions.items()},
            "gripper": {n: _rounded(v) for n, v in plotted.gripper.items()},
            "eef_speed": _rounded(plotted.eef_speed_m_s),
            "object_speed": {n: _rounded(v) for n, v in objects.items()},
            "places": {n: _place_json(p) for n, p in plotted.places.items()},
            "vote": _vote_json(ballot.votes.get(name)),
            "suggestions": None,
            "discussion": None,
        }
        if name in ballot.votes and name in ballot.revealed:
            own = suggest(steps, fps, info["first_step"])
            info["suggestions"] = [
                {"step": s.step, "text": " ".join(filter(None, (s.stage, s.deviation, s.reason))), "by": s.by}
                for s in (*candidate.suggestions, *own)
            ]
        if self.study.discussion is not None:
            info["discussion"] = dict(self.study.discussion.candidates[name])
        return info

    async def frames(self, request: Request) -> Response:
        """One pack of one camera's frames."""
        desk = self.desk(request)
        number = self.episode(desk, request.path_params["candidate"])
        camera = request.path_params["camera"]
        if camera not in self.study.frames.videos.cameras:
            raise Refusal(404, f"there is no camera {camera[:80]!r}")
        try:
            data = await run_in_threadpool(
                self.study.frames.pack, camera, number, request.path_params["pack"]
            )
        except IndexError as err:
            raise Refusal(416, str(err)) from None
        return Response(data, media_type="application/octet-stream")

    async def example(self, request: Request) -> Response:
        """One example frame of the guide."""
        self.desk(request)
        found = await run_in_threadpool(self.study.examples.picture, request.path_params["cell"])
        if found is None:
            coming = "; it is being rendered" if self.study.examples.coming else ""
            raise Refusal(404, f"there is no example frame of this cell{coming}")
        return Response(found[0], media_type=found[1])

    async def vote(self, request: Request) -> Response:
        """Takes a vote, and answers once it is on disk."""
        desk = self.desk(request)
        sent = await read_body(request)
        number = self.episode(desk, sent.get("candidate"))
        candidates = self.study.candidates
        try:
            vote = parse_vote(
                sent,
                first_step=first_step(candidates, number),
                steps=candidates.row(number).steps,
                human=candidates.candidates[number].source is Source.HUMAN,
            )
        except VoteError as err:
            raise Refusal(422, str(err)) from None
        taken = await run_in_threadpool(desk.book.add, vote)
        return JSONResponse({"vote": _vote_json(taken)})

    async def undo(self, request: Request) -> Response:
        """Takes the latest vote back."""
        desk = self.desk(request)
        sent = await read_body(request)
        uid = sent.get("uid")
        taken_back = await run_in_threadpool(desk.book.undo, uid) if isinstance(uid, str) else None
        if taken_back is None:
            raise Refusal(409, "this is not the latest vote; reload the page")
        ballot = desk.book.ballot()
        return JSONResponse(
            {
                "undone": _vote_json(taken_back),
                "vote": _vote_json(ballot.votes.get(taken_back.candidate)),
                "latest": ballot.order[-1] if ballot.order else None,
            }
        )

    async def reveal(self, request: Request) -> Response:
        """Shows the suggestions for an episode that has a vote, and notes that they were seen."""
        desk = self.desk(request)
        sent = await read_body(request)
        name = sent.get("candidate")
        number = self.episode(desk, name)
        if name not in desk.book.ballot().votes:
            raise Refusal(409, "suggestions are shown once the episode has your vote")
        await run_in_threadpool(desk.book.reveal, name)
        info = await run_in_threadpool(self._info, desk, name, number)
        return JSONResponse({"suggestions": info["suggestions"]})


def first_step(candidates: CandidateSet, episode: int) -> int:
    """The first step at which a recovery point may be: after the settling actions and at least one more."""
    reset = candidates.row(episode).reset_record()
    return (reset.settle_steps if reset else 0) + 1


def make_app(study: Study) -> Starlette:
    """The application."""
    handlers = Handlers(study)
    routes = [
        Route("/{annotator}/", handlers.page),
        Route("/{annotator}/{file}", handlers.page),
        Route("/{annotator}/api/session", handlers.session),
        Route("/{annotator}/api/episodes/{candidate}", handlers.episode_info),
        Route("/{annotator}/api/episodes/{candidate}/frames/{camera}/{pack:int}", handlers.frames),
        Route("/{annotator}/api/examples/{cell}", handlers.example),
        Route("/{annotator}/api/votes", handlers.vote, methods=["POST"]),
        Route("/{annotator}/api/undo", handlers.undo, methods=["POST"]),
        Route("/{annotator}/api/reveal", handlers.reveal, methods=["POST"]),
    ]

    async def refuse(_request: Request, err: Exception) -> Response:
        assert isinstance(err, Refusal)
        return JSONResponse({"error": err.message}, err.status)

    async def unusable(_request: Request, err: Exception) -> Response:
        return JSONResponse({"error": str(err)}, 500)

    app = Starlette(routes=routes, exception_handlers={Refusal: refuse, ScenarioError: unusable})
    app.router.redirect_slashes = False
    return guarded(app, study.hosts)


def _vote_json(vote: Vote | None) -> dict[str, Any] | None:
    if vote is None:
        return None
    shown = ("uid", "candidate", "verdict", "step", "stage", "deviation", "reason", "comment", "seconds")
    return {name: getattr(vote, name) for name in shown}


def _place_json(place: Place) -> dict[str, list[float] | None]:
    values = {"reach": place.reach_m, "goal": place.goal_m, "moved": place.moved_m, "height": place.height_m}
    return {name: None if v is None else _rounded(v) for name, v in values.items()}


def _rounded(values: Any) -> list[float]:
    return [round(float(v), 4) for v in values]
