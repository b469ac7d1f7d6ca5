"""The ways to co-design, each an object with the one method `run`."""
