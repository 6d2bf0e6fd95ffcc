"""What every report is made of: statistics, tables, pages, figures, files and the machine's description."""
