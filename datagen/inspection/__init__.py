"""What goes in and what came out, for people: tables, contact sheets, videos."""
