#!/bin/sh
# The whole loop in containers: simulated cell, service, one insertion. COMPOSE is the compose command with its file and project.
set -eu
: "${COMPOSE:?the compose command, as the Makefile passes it}"
here=$(dirname "$0")
port=${SERVICE_PORT:-8000}
$COMPOSE --profile sim up --detach
waited=0
until TACTILE_PORT=$port python3 -I -S "$here/healthcheck.py" "$port" /readyz; do
  waited=$((waited + 1))
  if [ "$waited" -gt "${READY_TIMEOUT_S:-300}" ]; then
    echo "up-sim: the service was not ready after $waited s; see: $COMPOSE logs service-sim cell" >&2
    exit 1
  fi
  sleep 1
done
echo "up-sim: ready after $waited s, dashboard at http://127.0.0.1:$port/"
$COMPOSE --profile sim-insert run --rm robot-client-sim
