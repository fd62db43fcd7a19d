#!/bin/bash
# Stands for Slurm's sbatch in tests: runs a batch file once per id of its array, one after the other, with the variables
# that Slurm sets. Usage: fake_sbatch.sh [--array=SPEC] FILE ARGUMENTS; a spec is such as 1-3, 0-6:2 or 3,7.
set -euo pipefail
spec=""
if [[ $1 == --array=* ]]; then spec=${1#--array=}; shift; fi
file=$1
spec=${spec:-$(sed -n 's/^#SBATCH --array=//p' "$file")}
ids=()
for part in ${spec//,/ }; do
    if [[ $part =~ ^([0-9]+)-([0-9]+)(:([0-9]+))?$ ]]; then
        for id in $(seq "${BASH_REMATCH[1]}" "${BASH_REMATCH[4]:-1}" "${BASH_REMATCH[2]}"); do ids+=("$id"); done
    else
        ids+=("$part")
    fi
done
failed=0
for id in "${ids[@]}"; do
    SLURM_ARRAY_TASK_ID=$id SLURM_ARRAY_TASK_COUNT=${#ids[@]} SLURM_ARRAY_TASK_MIN=${ids[0]} \
        SLURM_ARRAY_TASK_MAX=${ids[-1]} bash "$@" || failed=$?
done
exit "$failed"
