"""What is known of an object before its mesh is read: name, licence, annotation."""
