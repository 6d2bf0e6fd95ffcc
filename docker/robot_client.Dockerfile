# The robot client: httpx, protobuf, websockets and the contract. It has no network ports of its own but EGM's UDP one.
ARG BASE=docker.io/library/python:3.11-slim-bookworm@sha256:a36c24f9cbdf4fd0f52d67f0823eeac19c2028c637cecc392d97f980d4fec56b

FROM ${BASE} AS build
WORKDIR /build
COPY requirements/robot.txt requirements.txt
RUN python -m venv --without-pip /opt/venv \
 && python -m pip --python /opt/venv/bin/python install --no-cache-dir --only-binary :all: --require-hashes --no-deps \
    -r requirements.txt
COPY robot_client /opt/app/robot_client
COPY service/__init__.py /opt/app/service/__init__.py
COPY service/contract /opt/app/service/contract
RUN /opt/venv/bin/python -m compileall -q -j 0 /opt/app

FROM ${BASE}
ENV PATH=/opt/venv/bin:$PATH PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1 HOME=/tmp TACTILE_STATE=/var/lib/tactile/state
COPY --from=build /opt/venv /opt/venv
COPY --from=build /opt/app /opt/app
RUN install -d -o 10001 -g 10001 /var/lib/tactile /var/lib/tactile/episodes \
 && install -d -o 10001 -g 10001 -m 700 /var/lib/tactile/state
USER 10001:10001
# Episode logs go to the working directory unless told otherwise; the code is found by PYTHONPATH.
ENV PYTHONPATH=/opt/app
WORKDIR /var/lib/tactile/episodes
STOPSIGNAL SIGTERM
ENTRYPOINT ["python", "-m", "robot_client"]
CMD ["--help"]
