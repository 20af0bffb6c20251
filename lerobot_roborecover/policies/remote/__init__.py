"""Policies on another machine: the `remote` policy type, and the server behind `roborecover serve`.

Both ends speak openpi's protocol: msgpack over a websocket, arrays as `protocol` packs them, metadata as the
first message, errors as text. Nothing here unpickles anything.
"""
