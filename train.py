"""python train.py: see conf/train.yaml."""

from sdfnet.cli import train

if __name__ == "__main__":
    train()
