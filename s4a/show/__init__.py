"""Pictures, charts and pages; the scripts of the browser."""
