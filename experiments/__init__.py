"""The paper's table and figures, and the baselines that stand beside them; not part of the package."""
