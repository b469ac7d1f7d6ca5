"""Co-design methods, each an object with the method `run`."""
