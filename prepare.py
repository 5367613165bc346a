"""python prepare.py: see conf/prepare.yaml."""

from sdfnet.cli import prepare

if __name__ == "__main__":
    prepare()
