"""Exports of the page: view as PNG, flight as HTML, data of a UAV as CSV."""
