"""Video: ground the part once, follow it, and ground it again when it is lost."""
