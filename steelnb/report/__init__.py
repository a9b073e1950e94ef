"""Results → tables, sentences and figures, one module a notebook. Figures do not compute, tables do not plot."""
