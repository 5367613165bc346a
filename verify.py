"""python verify.py: see conf/verify.yaml."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when NumPy loads; on solids so small a second thread only waits

from sdfnet.cli import verify  # noqa: E402

if __name__ == "__main__":
    verify()
