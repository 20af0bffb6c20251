"""An annotation server in this process, and clients that talk to it."""

from __future__ import annotations

import threading
from contextlib import contextmanager

import httpx
import uvicorn

from lerobot_roborecover.curation.annotation.examples import Examples
from lerobot_roborecover.curation.annotation.frames import FramePacks, Videos
from lerobot_roborecover.curation.annotation.votes import VoteJournal
from lerobot_roborecover.curation.resolution import queued
from lerobot_roborecover.web.annotate.identity import names_of, queue_order
from lerobot_roborecover.web.annotate.server import AnnotationStudy, VotingSession, make_app
from lerobot_roborecover.web.guard import cookie_name
from lerobot_roborecover.web.serve import listen

TOKENS = {"ann": "a" * 32, "bob": "b" * 32}


class Annotator(httpx.Client):
    """One annotator's requests, with the token as its cookie."""

    def __init__(self, host, name, called):
        cookie = f"{cookie_name(name, TOKENS[name])}={TOKENS[name]}"
        super().__init__(base_url=f"http://{host}/{name}/", headers={"Cookie": cookie}, trust_env=False)
        self.called = called

    def episode(self, candidate: str) -> str:
        """What annotators call a candidate; another id stays as it is."""
        return self.called.episodes.get(candidate, candidate)

    def vote(self, of: str = "ep-0000", **changes) -> dict:
        """A vote on a candidate, as the page sends it."""
        base = {"uid": "uid-00000001", "dataset": self.called.dataset, "candidate": self.episode(of)}
        marks = {"verdict": "recovery", "step": 20, "stage": "Move", "deviation": "Wrong Pose"}
        return {**base, **marks, "comment": "", "seconds": 3, **changes}


@contextmanager
def serving(candidates, folder, names=("ann", "bob"), discussion=None):
    """A server on a port of its own; yields a client of each annotator, with the token as its cookie."""
    root = candidates.root
    store = FramePacks(Videos(root), [row.steps for row in candidates.trajectories.rows])
    queue = sorted(discussion.candidates if discussion else queued(candidates))
    rounds = discussion.round if discussion else 1
    called = names_of(candidates, folder)
    annotators = {
        n: VotingSession(TOKENS[n], VoteJournal(folder, n, rounds), queue_order(queue, n, 0)) for n in names
    }
    listener = listen(0)
    host = f"127.0.0.1:{listener.getsockname()[1]}"
    pictures = Examples(root, "fake", render=False)
    app = make_app(
        AnnotationStudy(candidates, called, store, pictures, annotators, frozenset({host}), discussion)
    )
    server = uvicorn.Server(uvicorn.Config(app, log_level="critical", lifespan="off"))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    clients = {n: Annotator(host, n, called) for n in names}
    try:
        yield clients
    finally:
        for client in clients.values():
            client.close()
        server.should_exit = True
        thread.join()
        listener.close()
        store.close()
        for annotator in annotators.values():
            annotator.book.close()
