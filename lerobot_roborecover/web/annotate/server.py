"""The page's server: every request checked, every answer to one annotator only.

Each annotator has a token and an address of their own, `/NAME/`. The first request carries the token in its
query and gets it as a cookie for that address; every further request, pictures included, must carry the
cookie (`web/guard.py`). Episodes go by names that tell nothing (`identity.py`), and a vote says which
dataset it is about: one of another is refused, never recorded.

Starlette and uvicorn rather than `http.server`: header, cookie and body parsing are what a server gets wrong,
and the same stack carries the live streams of `teleop`.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from lerobot_roborecover.curation.annotation.discussion import Discussion
from lerobot_roborecover.curation.annotation.examples import Examples
from lerobot_roborecover.curation.annotation.frames import PACK, FramePacks
from lerobot_roborecover.curation.annotation.guide import SLUGS, as_json
from lerobot_roborecover.curation.annotation.naming import camera_labels
from lerobot_roborecover.curation.annotation.shown import take_vote
from lerobot_roborecover.curation.annotation.votes import Vote, VoteError, VoteJournal
from lerobot_roborecover.curation.candidates import CandidateSet
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.web.annotate.identity import Names
from lerobot_roborecover.web.annotate.sheet import sheet, vote_json
from lerobot_roborecover.web.guard import Refusal, check_token, guarded, read_body, with_cookie
from lerobot_roborecover.web.page import PageFiles

MAX_ADOPTED = 100
"""Votes of an earlier version's page that are asked about at once."""
_PAGE = PageFiles(
    "lerobot_roborecover.web.annotate", "app.js", "drafts.js", "frames.js", "plots.js", "outbox.js",
    "panel.js", "player.js", "readout.js", "guide.js", "keys.js", "unsentVotes.js", "storage.js",
)  # fmt: skip


@dataclass(frozen=True)
class VotingSession:
    """One annotator at work."""

    token: str
    book: VoteJournal
    queue: Sequence[str]
    """Candidate ids in this annotator's order."""


@dataclass(frozen=True)
class AnnotationStudy:
    """Everything that is served."""

    candidates: CandidateSet
    names: Names
    """What annotators call the dataset and its episodes."""
    frames: FramePacks
    examples: Examples
    annotators: Mapping[str, VotingSession]
    """By annotator."""
    hosts: frozenset[str]
    """Host headers that name this server."""
    discussion: Discussion | None = None


class Handlers:
    """The answers, once a request has been checked."""

    def __init__(self, study: AnnotationStudy):
        self.study = study

    def annotator(self, request: Request) -> VotingSession:
        """The annotator that a request comes from, as far as it may be answered.

        Raises:
            Refusal: see `guard.check_token`.
        """
        name = request.path_params["annotator"]
        annotator = self.study.annotators.get(name)
        check_token(
            request, name, None if annotator is None else annotator.token, "roborecover curate annotate"
        )
        assert annotator is not None
        return annotator

    def candidate(self, annotator: VotingSession, name: object) -> str:
        """The candidate that an annotator calls so.

        Raises:
            Refusal: it is not in this annotator's queue.
        """
        found = self.study.names.candidates.get(name) if isinstance(name, str) else None
        if found is None or found not in annotator.queue:
            raise Refusal(404, f"there is no episode {str(name)[:80]!r} in this queue")
        return found

    def check_dataset(self, sent: Mapping[str, Any]) -> None:
        """Refuses what is about another dataset.

        Raises:
            Refusal: names both.
        """
        if sent.get("dataset") != self.study.names.dataset:
            raise Refusal(
                409,
                f"field dataset: this is about dataset {str(sent.get('dataset'))[:80]!r}, and this server "
                f"has {self.study.names.dataset!r}; open that dataset's page",
            )

    async def page(self, request: Request) -> Response:
        """A file of the page; the token in an address is exchanged for a cookie."""
        self.annotator(request)
        if "token" in request.query_params:
            return with_cookie(request, request.path_params["annotator"])
        return _PAGE.response(request.path_params.get("file", ""))

    async def session(self, request: Request) -> Response:
        """Who annotates what, how far they are, and the guide."""
        annotator, study = self.annotator(request), self.study
        ballot = annotator.book.ballot()
        return JSONResponse(
            {
                "annotator": annotator.book.annotator,
                "dataset": study.names.dataset,
                "platform": study.candidates.platform,
                "round": annotator.book.round,
                "fps": study.frames.videos.fps,
                "pack": PACK,
                "cameras": study.frames.videos.cameras,
                "camera_labels": camera_labels(study.frames.videos.cameras),
                "queue": [
                    {"id": name, "vote": vote_json(ballot.votes.get(c), name)}
                    for c, name in ((c, study.names.episodes[c]) for c in annotator.queue)
                ],
                "latest": ballot.order[-1] if ballot.order else None,
                "guide": as_json(),
            }
        )

    async def episode_info(self, request: Request) -> Response:
        """All that is known of an episode and may be shown."""
        annotator = self.annotator(request)
        candidate = self.candidate(annotator, request.path_params["episode"])
        number = self.study.candidates.by_id[candidate]
        ahead = annotator.queue.index(candidate) + 1
        self.study.frames.make_ahead(number)
        for following in annotator.queue[ahead : ahead + 1]:
            self.study.frames.make_ahead(self.study.candidates.by_id[following])
        return JSONResponse(await run_in_threadpool(self._sheet, annotator, candidate))

    def _sheet(self, annotator: VotingSession, candidate: str) -> dict[str, Any]:
        study = self.study
        discussed = None if study.discussion is None else study.discussion.candidates[candidate]
        return sheet(
            study.candidates, study.candidates.by_id[candidate], study.names.episodes[candidate],
            study.frames.videos.fps, annotator.book.ballot(), discussed,
        )  # fmt: skip

    async def frames(self, request: Request) -> Response:
        """One pack of one camera's frames."""
        annotator = self.annotator(request)
        number = self.study.candidates.by_id[self.candidate(annotator, request.path_params["episode"])]
        camera = request.path_params["camera"]
        if camera not in self.study.frames.videos.cameras:
            raise Refusal(404, f"there is no camera {camera[:80]!r}")
        pack = request.path_params["pack"]
        if not re.fullmatch("[0-9]{1,9}", pack):
            raise Refusal(404, f"there is no pack {pack[:80]!r}; packs are numbered from 0")
        try:
            data = await run_in_threadpool(self.study.frames.pack, camera, number, int(pack))
        except IndexError as err:
            raise Refusal(416, str(err)) from None
        return Response(data, media_type="application/octet-stream")

    async def example(self, request: Request) -> Response:
        """One example frame of the guide."""
        self.annotator(request)
        found = await run_in_threadpool(self.study.examples.picture, request.path_params["cell"])
        if found is None:
            coming = "; it is being rendered" if self.study.examples.coming else ""
            raise Refusal(404, f"there is no example frame of this cell{coming}")
        return Response(found[0], media_type=found[1])

    async def examples(self, request: Request) -> Response:
        """Which cells have an example frame, and whether more are coming."""
        self.annotator(request)
        there = self.study.examples
        found = [name for name in SLUGS if await run_in_threadpool(there.picture, name) is not None]
        return JSONResponse({"pictures": found, "coming": there.coming})

    async def vote(self, request: Request) -> Response:
        """Takes a vote, and answers once it is on disk."""
        annotator = self.annotator(request)
        sent = await read_body(request)
        self.check_dataset(sent)
        candidate = self.candidate(annotator, sent.get("candidate"))
        marks = {k: v for k, v in sent.items() if k != "dataset"}
        try:
            taken = await run_in_threadpool(
                take_vote, annotator.book, self.study.candidates, candidate, marks
            )
        except VoteError as err:
            raise Refusal(422, str(err)) from None
        return JSONResponse({"vote": self._vote_json(taken)})

    async def undo(self, request: Request) -> Response:
        """Takes the latest vote back."""
        annotator = self.annotator(request)
        sent = await read_body(request)
        uid = sent.get("uid")
        taken_back = await run_in_threadpool(annotator.book.undo, uid) if isinstance(uid, str) else None
        if taken_back is None:
            raise Refusal(409, "this is not the latest vote; reload the page")
        ballot = annotator.book.ballot()
        return JSONResponse(
            {
                "undone": self._vote_json(taken_back),
                "vote": self._vote_json(ballot.votes.get(taken_back.candidate)),
                "latest": ballot.order[-1] if ballot.order else None,
            }
        )

    async def reveal(self, request: Request) -> Response:
        """Shows the suggestions for an episode that has a vote, and notes that they were seen."""
        annotator = self.annotator(request)
        sent = await read_body(request)
        candidate = self.candidate(annotator, sent.get("candidate"))
        if candidate not in annotator.book.ballot().votes:
            raise Refusal(409, "suggestions are shown once the episode has your vote")
        await run_in_threadpool(annotator.book.reveal, candidate)
        info = await run_in_threadpool(self._sheet, annotator, candidate)
        return JSONResponse({"suggestions": info["suggestions"]})

    async def adopt(self, request: Request) -> Response:
        """Which episodes of this queue are meant by the ids that an earlier version's page has kept."""
        annotator = self.annotator(request)
        sent = await read_body(request)
        self.check_dataset(sent)
        asked = sent.get("candidates")
        if not isinstance(asked, list) or len(asked) > MAX_ADOPTED:
            raise Refusal(422, f"field candidates: it must be a list of at most {MAX_ADOPTED} ids")
        known = {
            c: self.study.names.episodes[c] for c in asked if isinstance(c, str) and c in annotator.queue
        }
        return JSONResponse({"episodes": known})

    def _vote_json(self, vote: Vote | None) -> dict[str, Any] | None:
        # An episode that was voted on and is not in the dataset any more has no name.
        if vote is None:
            return None
        return vote_json(vote, self.study.names.episodes.get(vote.candidate, ""))


def make_app(study: AnnotationStudy) -> Starlette:
    handlers = Handlers(study)
    routes = [
        Route("/{annotator}/", handlers.page),
        Route("/{annotator}/{file}", handlers.page),
        Route("/{annotator}/api/session", handlers.session),
        Route("/{annotator}/api/episodes/{episode}", handlers.episode_info),
        Route("/{annotator}/api/episodes/{episode}/frames/{camera}/{pack}", handlers.frames),
        Route("/{annotator}/api/examples", handlers.examples),
        Route("/{annotator}/api/examples/{cell}", handlers.example),
        Route("/{annotator}/api/votes", handlers.vote, methods=["POST"]),
        Route("/{annotator}/api/undo", handlers.undo, methods=["POST"]),
        Route("/{annotator}/api/reveal", handlers.reveal, methods=["POST"]),
        Route("/{annotator}/api/adopt", handlers.adopt, methods=["POST"]),
    ]

    async def refuse(_request: Request, err: Exception) -> Response:
        assert isinstance(err, Refusal)
        return JSONResponse({"error": err.message}, err.status)

    async def unusable(request: Request, err: Exception) -> Response:
        # The message names files and candidates, so it goes to the server's terminal only.
        episode = request.path_params.get("episode", "")
        candidate = study.names.candidates.get(episode, "")
        print(f"episode {episode} ({candidate}): {err}" if candidate else str(err), file=sys.stderr)
        return JSONResponse({"error": "the server cannot do this; its terminal says why"}, 500)

    app = Starlette(routes=routes, exception_handlers={Refusal: refuse, ScenarioError: unusable})
    app.router.redirect_slashes = False
    return guarded(app, study.hosts)
