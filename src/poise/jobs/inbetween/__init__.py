"""In-betweening networks from a folder of clips."""
