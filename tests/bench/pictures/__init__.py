"""The pictures of the README, taken of the page by a script."""
