"""Components of every report: statistics, tables, pages, figures, files and the machine's description."""
