#!/bin/bash
# Recovers the cloud on three nodes of a SLURM cluster: sbatch examples/cluster/slurm.sh
# The folder must be on a file system that all nodes see, and pathreplay[ray] installed on all of them.
#SBATCH --job-name=pathreplay
#SBATCH --nodes=3
#SBATCH --ntasks-per-node=1
#SBATCH --cpus-per-task=8
#SBATCH --exclusive
##SBATCH --gpus-per-task=4     # with CUDA: an actor for each GPU

set -euo pipefail

# Whoever has this token can run programs as you while the job runs, so it is new each time and only this user reads it.
export RAY_AUTH_MODE=token RAY_AUTH_TOKEN_PATH="$PWD/.ray-token-$SLURM_JOB_ID" RAY_USAGE_STATS_ENABLED=0
(umask 077; python3 -c 'import secrets; print(secrets.token_hex(32), end="")' > "$RAY_AUTH_TOKEN_PATH")
trap 'rm -f "$RAY_AUTH_TOKEN_PATH"' EXIT

# The address of the first node, at which its Ray listens; all others and this job go there.
head=$(scontrol show hostnames "$SLURM_JOB_NODELIST" | head -n 1)
export RAY_ADDRESS="$(srun --nodes=1 --ntasks=1 -w "$head" hostname --ip-address | awk '{print $1}'):6379"

# Starts Ray on every node, runs the command on the first one, and stops Ray again, whatever came of it.
srun --nodes="$SLURM_NNODES" --ntasks="$SLURM_NNODES" \
  ray symmetric-run --address "$RAY_ADDRESS" --min-nodes "$SLURM_NNODES" --num-cpus "$SLURM_CPUS_PER_TASK" \
  --include-dashboard=false -- pathreplay optimize examples/cluster/config.toml
