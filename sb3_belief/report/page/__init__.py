"""Self-contained pages of tables and figures: what is on them, their HTML, and the files beside them."""
