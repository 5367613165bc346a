"""python cost.py: see conf/cost.yaml."""

from sdfnet.cli import cost

if __name__ == "__main__":
    cost()
