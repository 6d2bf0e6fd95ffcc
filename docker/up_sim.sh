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
# What a client may know of the task differs from object to object; the cell wrote it down.
told=$($COMPOSE --profile sim exec -T cell python -c "import json
t = json.load(open('cell.json'))
print(t['approach']['z_mm'], t['gap_width_mm'], t['expected_depth_mm'])")
# shellcheck disable=SC2086 # three numbers
set -- $told
APPROACH_Z_MM=$1 GAP_WIDTH_MM=$2 EXPECTED_DEPTH_MM=$3
export APPROACH_Z_MM GAP_WIDTH_MM EXPECTED_DEPTH_MM
$COMPOSE --profile sim-insert run --rm -T robot-client-sim
