# RoboRecover on a CPU: Meta-World, PushT, Aloha, the demo, the tools around scenarios. From the root of this repository:
#
#     docker build -f docker/cpu.Dockerfile -t roborecover-cpu .
#     docker run --rm roborecover-cpu                       # roborecover doctor
#     docker run --rm -v "$PWD/outputs:/lerobot/outputs" roborecover-cpu roborecover demo
#
# As LeRobot's images: /lerobot with a virtual environment, the user user_lerobot. The base is pinned by its digest.
FROM python:3.12.15-slim-bookworm@sha256:54c85f3c47607a77f32adec749d3c81d1348bf25833671f512b26a9b6d778cb3

ENV DEBIAN_FRONTEND=noninteractive \
    MUJOCO_GL=egl \
    PATH=/lerobot/.venv/bin:$PATH

COPY scripts/uv_requirements.txt /tmp/
RUN apt-get update \
    && apt-get install -y --no-install-recommends \
        ffmpeg git libegl1 libegl-mesa0 libgl1-mesa-dri libosmesa6 \
    && rm -rf /var/lib/apt/lists/* \
    && pip install --no-cache-dir --only-binary :all: --require-hashes -r /tmp/uv_requirements.txt \
    && useradd --uid 1000 --create-home --shell /bin/bash user_lerobot \
    && mkdir /lerobot \
    && chown user_lerobot:user_lerobot /lerobot

USER 1000
WORKDIR /lerobot
ENV HOME=/home/user_lerobot \
    HF_HOME=/home/user_lerobot/.cache/huggingface

COPY --chown=user_lerobot:user_lerobot . .
# PyTorch without CUDA: some GB less.
RUN uv venv --python 3.12 \
    && uv pip install --no-cache --compile-bytecode --torch-backend=cpu -c constraints.txt -e ".[gym,build,remote]" \
    && mkdir -p outputs

CMD ["roborecover", "doctor"]
