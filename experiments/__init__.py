"""From a configuration to rows, tables, figures, claims and a report."""
