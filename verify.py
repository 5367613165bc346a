"""python verify.py: see conf/verify.yaml."""

from sdfnet.cli import verify

if __name__ == "__main__":
    verify()
