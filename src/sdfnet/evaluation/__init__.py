"""From distances back to surfaces, and how far those are from the truth, beside the baselines of METRICS."""
