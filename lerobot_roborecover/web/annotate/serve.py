"""Runs the annotation server: one address with a token an annotator, until it is stopped."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from lerobot_roborecover.curation.annotation.examples import Examples
from lerobot_roborecover.curation.annotation.frames import FramePacks, Videos
from lerobot_roborecover.curation.annotation.votes import VoteJournal, check_name, votes_folder
from lerobot_roborecover.curation.candidates import read_candidates
from lerobot_roborecover.curation.resolution import to_vote_on
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.web.annotate.identity import names_of
from lerobot_roborecover.web.annotate.queue import queue_order
from lerobot_roborecover.web.serve import HOST, kept_tokens, listen, make_server, own_hosts

DEFAULT_PORT = 8731


@dataclass(frozen=True)
class AnnotateConfig:
    """One annotation session."""

    dataset: Path
    """A candidate dataset."""
    annotators: Sequence[str]
    """Who takes part here; others may take part from servers of their own."""
    port: int = DEFAULT_PORT
    """0 takes a free one."""
    votes: Path | None = None
    """Folder of all votes; by default inside the dataset."""
    seed: int = 0
    """Of the queues' order."""
    only: Path | None = None
    """A list of candidates to discuss (`roborecover curate agree --discuss`)."""
    examples: bool = True
    """Render the guide's example frames where the dataset holds none."""


def serve(config: AnnotateConfig, say: Callable[[str], None]) -> None:
    """Serves until the process is interrupted.

    Args:
        config: the session.
        say: told the addresses, one line each.

    Raises:
        ScenarioError: something cannot be read, the port is taken, or an annotator is served elsewhere.
    """
    try:
        import uvicorn  # noqa: F401 - what is missing is said before anything is read

        from lerobot_roborecover.web.annotate.server import AnnotationStudy, VotingSession, make_app
    except ImportError as err:
        raise ScenarioError(
            f"the page needs {err.name}: pip install 'lerobot_env_roborecover[build]'"
        ) from None
    candidates = read_candidates(config.dataset)
    frames = FramePacks(Videos(config.dataset), [row.steps for row in candidates.trajectories.rows])
    wanted, discussion = to_vote_on(candidates, config.only)
    folder = votes_folder(config.dataset, config.votes)
    names = [check_name(name) for name in config.annotators]
    if len(set(names)) < len(names):
        raise ScenarioError(f"an annotator is named twice: {', '.join(names)}")
    listener = listen(config.port)
    port = listener.getsockname()[1]
    books: list[VoteJournal] = []
    examples = Examples(config.dataset, candidates.platform, render=config.examples)
    try:
        tokens = kept_tokens("annotate", folder, names)
        annotators = {}
        for name in names:
            books.append(VoteJournal(folder, name, discussion.round if discussion else 1))
            annotators[name] = VotingSession(
                tokens[name], books[-1], queue_order(sorted(wanted), name, config.seed)
            )
        called = names_of(candidates, folder)
        app = make_app(
            AnnotationStudy(candidates, called, frames, examples, annotators, own_hosts(port), discussion)
        )
        for name in names:
            done = len(set(annotators[name].book.ballot().votes) & wanted)
            say(f"{name}: {done} of {len(wanted)} done  http://{HOST}:{port}/{name}/?token={tokens[name]}")
        say(f"the page calls this dataset {called.dataset}: its name might tell the controller")
        say(f"votes are kept in {folder}; Ctrl-C stops, the same command goes on")
        make_server(app).run(sockets=[listener])
    finally:
        for book in books:
            book.close()
        frames.close()
        examples.close()
        listener.close()
