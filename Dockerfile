# op3 without a GPU: docker build -t op3 . && docker run --rm -v "$PWD/outputs:/work/outputs" op3 demo diagnose
FROM python:3.11-slim

RUN apt-get update \
    && apt-get install --yes --no-install-recommends libegl1 libgl1 libgl1-mesa-dri \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /src
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY op3 op3
COPY hydra_plugins hydra_plugins
COPY conf conf
COPY assets assets
RUN pip install --no-cache-dir --index-url https://download.pytorch.org/whl/cpu --extra-index-url https://pypi.org/simple \
        -c constraints.txt torch \
    && pip install --no-cache-dir -c constraints.txt '.[stand-in,video]'
ENV MUJOCO_GL=egl
WORKDIR /work
ENTRYPOINT ["op3"]
CMD ["--help"]
