#!/usr/bin/env bash
# Install Chromium for the tests in this folder, where Debian's package manager may be used. Elsewhere they skip.
set -euo pipefail

for name in chromium chromium-browser google-chrome; do
  command -v "$name" > /dev/null && exit 0
done
if ! command -v apt-get > /dev/null; then
  echo "no Chromium, and no apt-get to install it: the browser tests skip"
  exit 0
fi
if [ "$(id -u)" = 0 ]; then
  as_root=()
elif sudo -n true 2> /dev/null; then
  as_root=(sudo -n)
else
  echo "no Chromium, and no right to install it: the browser tests skip"
  exit 0
fi
"${as_root[@]}" apt-get install --yes --quiet --no-install-recommends chromium ||
  { "${as_root[@]}" apt-get update --quiet && "${as_root[@]}" apt-get install --yes --quiet --no-install-recommends chromium; } ||
  echo "Chromium could not be installed: the browser tests skip"
