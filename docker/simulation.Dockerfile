# The simulated cell: the physics behind the real protocols (EGM, RWS, WSG-50, two camera streams). No torch.
ARG BASE=docker.io/library/python:3.11-slim-bookworm@sha256:a36c24f9cbdf4fd0f52d67f0823eeac19c2028c637cecc392d97f980d4fec56b

FROM ${BASE} AS build
WORKDIR /build
COPY requirements/simulation.txt requirements.txt
RUN python -m venv --without-pip /opt/venv \
 && python -m pip --python /opt/venv/bin/python install --no-cache-dir --only-binary :all: --require-hashes --no-deps \
    -r requirements.txt
COPY simulation /opt/app/simulation
COPY reporting /opt/app/reporting
COPY service/__init__.py /opt/app/service/__init__.py
COPY service/contract /opt/app/service/contract
COPY service/perception /opt/app/service/perception
COPY service/sensors /opt/app/service/sensors
COPY robot_client/__init__.py /opt/app/robot_client/__init__.py
COPY robot_client/insertion /opt/app/robot_client/insertion
COPY robot_client/robots /opt/app/robot_client/robots
COPY robot_client/grippers /opt/app/robot_client/grippers
COPY docker/healthcheck.py /opt/app/healthcheck.py
RUN /opt/venv/bin/python -m compileall -q -j 0 /opt/app

FROM ${BASE}
# Numba compiles for the processor it finds; its cache lies in a volume, so that only the first start pays.
ENV PATH=/opt/venv/bin:$PATH PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1 \
    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MPLCONFIGDIR=/tmp/matplotlib HOME=/tmp \
    NUMBA_CACHE_DIR=/var/lib/tactile/numba PYTHONPATH=/opt/app
COPY --from=build /opt/venv /opt/venv
COPY --from=build /opt/app /opt/app
RUN install -d -o 10001 -g 10001 /var/lib/tactile /var/lib/tactile/numba /var/lib/tactile/cell
USER 10001:10001
WORKDIR /var/lib/tactile/cell
STOPSIGNAL SIGTERM
ENTRYPOINT ["python", "-m", "simulation"]
CMD ["cell", "--object", "rectangle"]
