#!/bin/bash
# Recover the cloud on three nodes of a SLURM cluster: sbatch examples/cluster/slurm.sh
# The folder must be on a file system that all nodes share, and pathreplay[ray] must be installed on all nodes.
#SBATCH --job-name=pathreplay
#SBATCH --nodes=3
#SBATCH --ntasks-per-node=1
#SBATCH --cpus-per-task=8
#SBATCH --exclusive
##SBATCH --gpus-per-task=4     # with CUDA: one actor per GPU

set -euo pipefail

# Anyone with this token can run programs as you during the job, so each job gets a new one that only you can read.
export RAY_AUTH_MODE=token RAY_AUTH_TOKEN_PATH="$PWD/.ray-token-$SLURM_JOB_ID" RAY_USAGE_STATS_ENABLED=0
(umask 077; python3 -c 'import secrets; print(secrets.token_hex(32), end="")' > "$RAY_AUTH_TOKEN_PATH")
trap 'rm -f "$RAY_AUTH_TOKEN_PATH"' EXIT

# Address of the first node, to which the other nodes and the job connect.
head=$(scontrol show hostnames "$SLURM_JOB_NODELIST" | head -n 1)
export RAY_ADDRESS="$(srun --nodes=1 --ntasks=1 -w "$head" hostname --ip-address | awk '{print $1}'):6379"

# Start Ray on every node, run the command on the first one, and stop Ray even if the command fails.
srun --nodes="$SLURM_NNODES" --ntasks="$SLURM_NNODES" \
  ray symmetric-run --address "$RAY_ADDRESS" --min-nodes "$SLURM_NNODES" --num-cpus "$SLURM_CPUS_PER_TASK" \
  --include-dashboard=false -- pathreplay optimize examples/cluster/config.toml
