import os

# Threads of torch would fight over the cores of the test processes; read when torch loads.
os.environ.setdefault("OMP_NUM_THREADS", "1")
