"""The page: a server that shows characters and takes commands and streams; it knows no physics."""
