#!/bin/sh
# Install this bundle on a cell without internet. usage: ./install.sh [--prefix DIR] [--no-systemd]
# Between insertions: at the end it restarts the services that run.
set -eu
umask 022  # a hardened machine hides what root writes from the user that the service runs as
prefix=/opt/tactile-insertion
units=yes
while [ $# -gt 0 ]; do
  case $1 in
    --prefix) [ $# -ge 2 ] || { echo "install: --prefix needs a folder" >&2; exit 2; }; prefix=$2; shift 2 ;;
    --no-systemd) units=no; shift ;;
    *) echo "install: unknown option $1, expected --prefix DIR or --no-systemd" >&2; exit 2 ;;
  esac
done
case $prefix in /*) ;; *) prefix=$PWD/$prefix ;; esac  # the unit takes nothing else
cd "$(dirname "$0")"
sha256sum --check --quiet SHA256SUMS || { echo "install: the bundle is damaged, nothing was installed" >&2; exit 2; }
python3 -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "install: Python 3.11 or newer is needed" >&2; exit 2; }
mkdir -p "$prefix"
rm -rf "$prefix/app.new" "$prefix/venv.new"
cp -r app "$prefix/app.new"
chmod -R go+rX "$prefix/app.new"  # it may have been unpacked under another umask
cp SHA256SUMS "$prefix/app.new/SHA256SUMS"
# The same bundle once more repairs its installation: the version to go back to stays the one before it.
old=old
! cmp -s SHA256SUMS "$prefix/app/SHA256SUMS" || old=replaced
# Two folders, renamed at the end: a failed installation leaves the running version as it was.
python3 -m venv "$prefix/venv.new"
"$prefix/venv.new/bin/python" -m pip install -q --no-index --find-links wheels --require-hashes --no-deps -r app/requirements/run.txt
"$prefix/venv.new/bin/python" -m compileall -q "$prefix/app.new"
for part in app venv; do
  rm -rf "$prefix/$part.$old"
  [ ! -e "$prefix/$part" ] || mv "$prefix/$part" "$prefix/$part.$old"
  mv "$prefix/$part.new" "$prefix/$part"
done
rm -rf "$prefix/app.replaced" "$prefix/venv.replaced"
if [ "$units" = yes ]; then
  id tactile >/dev/null 2>&1 || useradd --system --home-dir /var/lib/tactile-insertion --shell /usr/sbin/nologin tactile
  # To go back takes the old unit, too: the new one may name folders that the old version does not have.
  [ "$old" = replaced ] || [ ! -e /etc/systemd/system/tactile-insertion@.service ] \
    || cp /etc/systemd/system/tactile-insertion@.service "$prefix/tactile-insertion@.service.old"
  sed "s#/opt/tactile-insertion#$prefix#g" tactile-insertion@.service >"$prefix/tactile-insertion@.service"
  install -D -m 644 "$prefix/tactile-insertion@.service" /etc/systemd/system/tactile-insertion@.service
  install -d -m 755 /etc/tactile-insertion
  [ -e /etc/tactile-insertion/cell-a.env ] || install -m 640 -g tactile cell.env.example /etc/tactile-insertion/cell-a.env
  systemctl daemon-reload
  # One that runs has the old code in memory and would go on with it, beside the new pages and networks on the disk.
  systemctl try-restart 'tactile-insertion@*'
  echo "edit /etc/tactile-insertion/cell-a.env, then: systemctl enable --now tactile-insertion@cell-a"
fi
echo "installed in $prefix"
