#!/bin/bash

# Parameters
#SBATCH --array=0-6%2
#SBATCH --cpus-per-task=1
#SBATCH --job-name=scenegen
#SBATCH --nodes=1
#SBATCH --open-mode=append
#SBATCH --output=/tmp/wt/reach/scenegen-slurm-wj1qrfey/%A_%a_0_log.out
#SBATCH --signal=USR2@90
#SBATCH --time=240
#SBATCH --wckey=submitit

# command
export SUBMITIT_EXECUTOR=slurm
srun --unbuffered --output /tmp/wt/reach/scenegen-slurm-wj1qrfey/%A_%a_%t_log.out /tmp/wt/reach/.venv/bin/python -u -m submitit.core._submit /tmp/wt/reach/scenegen-slurm-wj1qrfey
