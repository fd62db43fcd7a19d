"""Tables and pages for readers: Markdown, LaTeX, CSV and HTML, in which text of others stays text."""
