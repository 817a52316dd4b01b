# Read by `run` and `deep`: a place outside the checkout for everything that they make.
checkout=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT

# What is never imported need not be compiled to bytecode.
export PIP_QUIET=1 PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_COMPILE=1
unset PYTHONPATH PYTHONHOME
if [[ -z ${SCENELOOM_DATA:-} && -d $checkout/../shared/data ]]; then
  SCENELOOM_DATA=$(cd "$checkout/../shared/data" && pwd)
  export SCENELOOM_DATA
fi

# Go to a copy of the files under version control, so that nothing is left behind in the checkout and no file
# that was forgotten helps.
enter_copy() {
  mkdir "$scratch/sceneloom"
  cd "$checkout"
  if git rev-parse --is-inside-work-tree >/dev/null 2>&1; then
    git ls-files -z | while IFS= read -r -d '' name; do
      if [[ -e $name ]]; then printf '%s\0' "$name"; fi
    done | tar --create --null --files-from=- | tar --extract --directory "$scratch/sceneloom"
  else
    cp -R . "$scratch/sceneloom"
  fi
  cd "$scratch/sceneloom"
}

# python_works PYTHON CONDITION: whether it runs and its version fulfils the condition on `v`.
python_works() {
  "$1" -c "import sys; v = sys.version_info[:2]; sys.exit(not ($2))" 2>/dev/null
}

declare -a failed=()

# step COMMAND: run it, keep its output in $scratch/output, remember its failure.
step() {
  local started=$SECONDS
  printf '\n== %s\n' "$1"
  if bash -c "$1" 2>&1 | tee "$scratch/output"; then
    printf '== done after %d s\n' $((SECONDS - started))
  else
    printf '== FAILED after %d s: %s\n' $((SECONDS - started)) "$1"
    failed+=("$1")
  fi
}

# The closing words of pytest in $scratch/output: from the list of failures on where there is one, else the last line.
pytest_summary() {
  sed -n '/short test summary info/,$p' "$scratch/output" | grep . || tail -n 1 "$scratch/output"
}

print_failures() {
  printf '\n== %d s in all\n' "$SECONDS"
  ((${#failed[@]} == 0)) || printf '== FAILED: %s\n' "${failed[@]}"
}
