# For clusters: docker build -t mjx_revolve . && docker run -v "$PWD/runs:/work/runs" mjx_revolve evolve lake_swim
FROM python:3.12-slim
# OpenGL in software, for films.
RUN apt-get update && apt-get install --yes --no-install-recommends libegl1 libosmesa6 && rm -rf /var/lib/apt/lists/*
COPY . /source
RUN pip install --no-cache-dir "/source[all]" && rm -rf /source
WORKDIR /work
ENTRYPOINT ["mjx-revolve"]
