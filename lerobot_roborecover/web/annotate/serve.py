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
from lerobot_roborecover.utils.options import option
from lerobot_roborecover.utils.text import install_command
from lerobot_roborecover.web.annotate.identity import names_of, queue_order
from lerobot_roborecover.web.serve import HOST, kept_tokens, listen, make_server, own_hosts

DEFAULT_PORT = 8731


@dataclass(frozen=True)
class AnnotateConfig:
    """One annotation session."""

    dataset: Path = option(positional=True)
    """Folder of a candidate dataset."""
    annotators: Sequence[str] = option((), name="annotator", metavar="NAME")
    """Who annotates; repeat it for several at once, each with an address of their own.

    Others may take part from servers of their own.
    """
    port: int = DEFAULT_PORT
    """On this machine alone; 0 takes a free one."""
    votes: Path | None = option(None, metavar="FOLDER")
    """Of all votes (DATASET/meta/roborecover/votes)."""
    seed: int = 0
    """Seed of the order in which each annotator sees the episodes."""
    only: Path | None = option(None, metavar="LIST")
    """A further round over what `roborecover curate agree --discuss` lists."""
    examples: bool = True
    """Render no example frames for the guide; those in the dataset are shown in any case."""


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
        raise ScenarioError(f"the page needs {err.name}: {install_command('build')}") from None
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
