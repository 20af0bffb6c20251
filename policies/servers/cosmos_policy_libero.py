"""Cosmos Policy on LIBERO behind openpi's protocol; `--policy.mapping=cosmos_policy` asks it.

In Cosmos Policy's own environment (`uv sync --extra cu128 --group libero`, and `uv pip install websockets
msgpack`), from its checkout:

    PYTHONPATH=. python /path/to/policies/servers/cosmos_policy_libero.py

Loads and calls the model as experiments/robot/libero/run_libero_eval.py of NVlabs/cosmos-policy does at
18a2acc, with the flags of its LIBERO.md. Its constants are chosen by the word "libero" on the command line:
keep this file's name.
"""

from __future__ import annotations

import argparse
import os

import numpy as np
from policy_server import serve

CHECKPOINT = "nvidia/Cosmos-Policy-LIBERO-Predict2-2B"


def load(checkpoint=CHECKPOINT, seed=195):
    """`infer` of a checkpoint."""
    os.environ["DETERMINISTIC"] = "True"
    from cosmos_policy.experiments.robot import cosmos_utils as cosmos
    from cosmos_policy.experiments.robot.libero.run_libero_eval import PolicyEvalConfig
    from cosmos_policy.utils.utils import set_seed_everywhere

    config = PolicyEvalConfig(
        config="cosmos_predict2_2b_480p_libero__inference_only", ckpt_path=checkpoint,
        dataset_stats_path=f"{checkpoint}/libero_dataset_statistics.json",
        t5_text_embeddings_path=f"{checkpoint}/libero_t5_embeddings.pkl",
        use_wrist_image=True, use_proprio=True, normalize_proprio=True, unnormalize_actions=True,
        trained_with_image_aug=True, chunk_size=16, num_open_loop_steps=16, seed=seed, randomize_seed=False,
        use_variance_scale=False, deterministic=True, use_jpeg_compression=True, flip_images=True,
        num_denoising_steps_action=5,
    )  # fmt: skip
    set_seed_everywhere(seed)
    cosmos.init_t5_text_embeddings_cache(config.t5_text_embeddings_path)
    stats = cosmos.load_dataset_stats(config.dataset_stats_path)
    model, _ = cosmos.get_model(config)

    def infer(request):
        observation = {key: request[key] for key in ("primary_image", "wrist_image", "proprio")}
        result = cosmos.get_action(
            config, model, stats, observation, request["task_description"], seed=seed, randomize_seed=False,
            num_denoising_steps_action=config.num_denoising_steps_action,
            generate_future_state_and_value_in_parallel=True,
        )  # fmt: skip
        return {"actions": np.stack([np.asarray(a, np.float32) for a in result["actions"]])}

    return infer


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--checkpoint", default=CHECKPOINT)
    parser.add_argument("--seed", type=int, default=195)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=8000)
    args = parser.parse_args()
    serve(
        load(args.checkpoint, args.seed), {"policy": os.path.basename(args.checkpoint)}, args.host, args.port
    )
