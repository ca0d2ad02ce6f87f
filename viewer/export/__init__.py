"""What can be taken away from the page: a picture of the view, a flight that plays anywhere, the numbers of a UAV."""
