#!/usr/bin/env bash
# An evaluation as a job on the Hub's machines; what it finishes goes to a bucket, which it can write to, so that a job that is
# cut off, and started again by the same line, goes on where it was.
#
#     IMAGE=you/roborecover-libero OUTPUTS=hf://buckets/you/recovery FLAVOR=a100-large \
#         docker/hf_job.sh reproduce pi05_libero --set policy.device=cuda --out /outputs/pi05_libero
#
# IMAGE is one of docker/*.Dockerfile on a registry that the Hub can reach. DRY_RUN=1 prints the job and starts nothing.
set -euo pipefail
: "${IMAGE:?the image, e.g. you/roborecover-libero}" "${OUTPUTS:?where results go, e.g. hf://buckets/you/recovery}"
options=(--flavor "${FLAVOR:-a10g-large}" --timeout "${TIMEOUT:-12h}" --volume "$OUTPUTS:/outputs" --detach)
# Private checkpoints and scenario sets are read with the caller's token.
[[ -n "${PUBLIC_ONLY:-}" ]] || options+=(--secrets HF_TOKEN)
[[ -z "${DRY_RUN:-}" ]] || options+=(--dry-run)
exec hf jobs run "${options[@]}" "$IMAGE" roborecover "$@"
