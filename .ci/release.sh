#!/usr/bin/env bash
# Both files of a release, made in FOLDER, looked into, installed one after the other over what is there, and tried from an empty folder.
# Needs an environment with torchchain's dependencies and the package build: bash .ci/release.sh FOLDER
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
python -m build --outdir "$1" . > /dev/null
python .ci/check_dist.py "$1"
version=$(sed -n 's/^__version__ = "\(.*\)"/\1/p' torchchain/_version.py)
dist=$(cd "$1" && pwd)
empty=$(mktemp -d)
trap 'rm -rf "$empty"' EXIT
cd "$empty"
for file in "$dist"/*.tar.gz "$dist"/*.whl; do
    pip install --quiet --no-deps --force-reinstall "$file"
    [ "$(torchchain --version)" = "torchchain $version" ]
    torchchain calibrate --n-particles 32 --n-bands 4 --realizations 8 --method modes --out run > /dev/null
    python -c '
import torchchain as tc
run = tc.open("run")
assert run.master.n_bands == 4 and run.transfer.mean.shape == (4, 201, 4), run
assert "site-packages" in tc.__file__, tc.__file__'
    echo "$(basename "$file") installs and runs"
done
