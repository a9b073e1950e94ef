"""Results → tables, sentences and figures, by subject. Figures do not compute, tables do not plot."""
