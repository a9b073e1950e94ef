"""What notebooks call: runs, the cases and plots of the report, tables, results."""
