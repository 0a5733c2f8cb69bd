#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# Checks the four system libraries that open3d and pymeshlab load; installs them with apt where that is allowed.
set -u

missing=""
for pair in libEGL.so.1:libegl1 libGL.so.1:libgl1 libOpenGL.so.0:libopengl0 libusb-1.0.so.0:libusb-1.0-0 libgomp.so.1:libgomp1; do
  library=${pair%%:*}
  if ! { ldconfig -p 2>/dev/null || /sbin/ldconfig -p; } | grep -q "$library"; then missing="$missing ${pair##*:}"; fi
done
[ -z "$missing" ] && exit 0
[ "$(uname -s)" = Linux ] || exit 0

if command -v apt-get >/dev/null 2>&1; then
  if [ "$(id -u)" = 0 ]; then as_root=""; elif sudo -n true 2>/dev/null; then as_root="sudo"; else as_root=none; fi
  if [ "$as_root" != none ]; then
    echo "installing system libraries:$missing"
    # shellcheck disable=SC2086
    $as_root apt-get update -qq && DEBIAN_FRONTEND=noninteractive $as_root apt-get install -y -qq --no-install-recommends $missing >/dev/null && exit 0
  fi
fi
echo "system libraries are missing; install them with:  sudo apt-get install$missing" >&2
exit 1
