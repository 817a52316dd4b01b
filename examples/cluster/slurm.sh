#!/bin/bash
#SBATCH --ntasks=256 --cpus-per-task=1 --mem-per-cpu=2G
# A verb over many drives on the tasks of a SLURM job, scheduler and run on its first node:
#
#     sbatch slurm.sh fuse "/fleet/drives/*" -o /fleet/fused
#
# The job has the exit code of the batch. After `scancel`, or where its time was up, the same command goes on with what
# is left.
export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 NUMBA_NUM_THREADS=1 MALLOC_ARENA_MAX=1
export DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED=False NUMBA_CACHE_DIR=${NUMBA_CACHE_DIR-$HOME/kernels}
port=$((20000 + SLURM_JOB_ID % 20000)) # jobs that share a node have schedulers of their own
dask scheduler --host "$(hostname)" --port $port --dashboard-address :0 &
trap "kill $!" EXIT # else it may outlive the job, and the next one would find it
srun dask worker "tcp://$(hostname):$port" --no-nanny --nthreads 1 &
sceneloom batch "$@" --cluster "tcp://$(hostname):$port" --resume
