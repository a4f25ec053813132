"""Messages as drawings, shown in Rerun or exported."""
