"""What a robot did, analysed once and drawn: pictures, films, the viewer's page, reports."""
