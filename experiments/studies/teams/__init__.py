"""Teams: what gil2008 expects of robots that see one another."""
