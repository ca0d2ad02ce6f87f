"""What runs or is stored in the browser, and the HTTP server in front of the page."""
