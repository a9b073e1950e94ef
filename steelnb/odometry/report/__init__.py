"""The report's programs as they were, with their faults."""
