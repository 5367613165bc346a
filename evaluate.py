"""python evaluate.py: see conf/evaluate.yaml."""

from sdfnet.cli import evaluate

if __name__ == "__main__":
    evaluate()
