#!/bin/sh
# The whole loop in containers: simulated cell, service, one insertion. COMPOSE is the compose command with its file and project.
set -eu
: "${COMPOSE:?the compose command, as the Makefile passes it}"
here=$(dirname "$0")
port=${SERVICE_PORT:-8000}
waited=0
ready() { # NAME PORT PATH: wait until the container answers
  until TACTILE_PORT=$2 python3 -I -S "$here/healthcheck.py" "$2" "$3"; do
    waited=$((waited + 1))
    if [ "$waited" -gt "${READY_TIMEOUT_S:-300}" ]; then
      echo "up-sim: $1 was not ready after $waited s; see: $COMPOSE logs $1" >&2
      exit 1
    fi
    sleep 1
  done
}
$COMPOSE --profile sim up --detach cell
ready cell "${ADMIN_PORT:-8184}" /healthz
$COMPOSE --profile sim up --detach service-sim
ready service-sim "$port" /readyz
echo "up-sim: ready after $waited s, dashboard at http://127.0.0.1:$port/"
$COMPOSE --profile sim-insert run --rm -T robot-client-sim
