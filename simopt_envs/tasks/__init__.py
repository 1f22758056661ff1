"""The tasks, and the single and vector environments that run them."""
