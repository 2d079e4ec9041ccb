#!/bin/bash
# A wheel as a new user has it: installed into a fresh environment, away from the repository, then s4a doctor and s4a demo.
#   tools/try.sh dist/s4a-0.1.0-py3-none-any.whl [STUDY OPTIONS OF s4a demo...]
set -euo pipefail
wheel=$(realpath "$1")
shift
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
unset PYTHONPATH
"${PYTHON:-python3}" -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check "$wheel"
venv/bin/s4a --version
venv/bin/s4a doctor
venv/bin/s4a demo "$@"
ls -l demo/study.html
