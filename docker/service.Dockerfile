# The decision service: numpy, OpenCV, onnxruntime, FastAPI. No torch, no compiler, no pip, no shell needed at run time.
# Builds alike with docker, podman and buildah, from the repository root: `make image`.
ARG BASE=docker.io/library/python:3.11-slim-bookworm@sha256:a36c24f9cbdf4fd0f52d67f0823eeac19c2028c637cecc392d97f980d4fec56b

FROM ${BASE} AS build
WORKDIR /build
COPY requirements/service.txt requirements.txt
RUN python -m venv --without-pip /opt/venv \
 && python -m pip --python /opt/venv/bin/python install --no-cache-dir --only-binary :all: --require-hashes --no-deps \
    -r requirements.txt
COPY service /opt/app/service
COPY docker/healthcheck.py /opt/app/healthcheck.py
RUN /opt/venv/bin/python -m compileall -q -j 0 /opt/app

FROM ${BASE}
ENV PATH=/opt/venv/bin:$PATH PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1 \
    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 HOME=/tmp \
    TACTILE_MODELS=/models TACTILE_RECORDINGS=/var/lib/tactile/recordings TACTILE_STATE=/var/lib/tactile/state
COPY --from=build /opt/venv /opt/venv
COPY --from=build /opt/app /opt/app
COPY models/pressing /models
# The places that are written to; a named volume inherits their owner. Everything else may be read-only.
RUN install -d -o 10001 -g 10001 /var/lib/tactile /var/lib/tactile/recordings \
 && install -d -o 10001 -g 10001 -m 700 /var/lib/tactile/state
USER 10001:10001
WORKDIR /opt/app
EXPOSE 8000
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=10s --timeout=3s --start-period=60s --retries=3 \
    CMD ["python", "-I", "-S", "/opt/app/healthcheck.py", "8000", "/readyz"]
ENTRYPOINT ["python", "-m", "service"]
CMD ["run"]
