"""vla-eval's own model server, around a function."""

from __future__ import annotations

import threading
from contextlib import contextmanager

from tests.support.processes import PATIENCE_S


@contextmanager
def model_server(predict, chunk=None, specs=({}, {}), params=None):
    """The package's server around a function of an observation; yields its address and what it was told."""
    import anyio
    from vla_eval.model_servers.predict import PredictModelServer
    from vla_eval.model_servers.serve import serve_async
    from vla_eval.specs import DimSpec

    told: list = []

    class Model(PredictModelServer):
        def predict(self, obs, ctx):
            told.append(("observation", obs))
            return {"actions": predict(obs)}

        async def on_episode_start(self, config, ctx):
            told.append(("start", config))
            self._chunk_buffers.pop(ctx.session_id, None)

        async def on_episode_end(self, result, ctx):
            told.append(("end", result))

        def get_action_spec(self):
            return {k: DimSpec(k, *v) for k, v in specs[0].items()}

        def get_observation_spec(self):
            return {k: DimSpec(k, *v) for k, v in specs[1].items()}

        def get_observation_params(self):
            return params or {}

    up, found = threading.Event(), []

    async def run():
        async with anyio.create_task_group() as group:
            found.append(await group.start(serve_async, Model(chunk_size=chunk), "127.0.0.1", 0))
            found.append(group.cancel_scope)
            up.set()

    async def whole():
        found.append(anyio.lowlevel.current_token())
        await run()

    thread = threading.Thread(target=lambda: anyio.run(whole), daemon=True)
    thread.start()
    assert up.wait(PATIENCE_S)
    token, port, scope = found
    try:
        yield f"ws://127.0.0.1:{port}", told
    finally:
        anyio.from_thread.run_sync(scope.cancel, token=token)
        thread.join(PATIENCE_S)
