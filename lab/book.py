#!/usr/bin/env python3
"""Preprocessor of mdBook (book.toml): includes pages of the repository and makes their links valid in the book.

A link to a page of the book becomes a link to its chapter. A link to another file of the repository leads from
out/book to that file. Standard library only.
"""
import json, posixpath, sys

from links import LINK, included, masked, split

OUT = 'out/book'


def chapters(items):
    for item in items:
        if isinstance(item, dict) and 'Chapter' in item:
            chapter = item['Chapter']
            yield chapter
            yield from chapters(chapter['sub_items'])


def target(found, chapter, pages):
    """Returns the link in the built book for a path of the repository."""
    path, anchor = found
    folder = posixpath.dirname(chapter)
    if path in pages:
        name = pages[path]
        if posixpath.basename(name) == 'README.md':
            name = posixpath.join(posixpath.dirname(name), 'index.md')
        link = posixpath.relpath(name, folder or '.')
    elif path.startswith('docs/') and not path.endswith('.md'):
        link = posixpath.relpath(path[len('docs/'):], folder or '.')
    else:
        if path.endswith('.md'):
            path = posixpath.dirname(path)
        link = posixpath.relpath(path or '.', posixpath.join(OUT, folder))
    return f'{link}#{anchor}' if anchor else link


def main():
    if len(sys.argv) > 1 and sys.argv[1] == 'supports':
        return
    _, book = json.load(sys.stdin)
    every = list(chapters(book.get('sections') or book.get('items')))
    texts = {}
    for chapter in every:
        source = chapter.get('source_path') or chapter['path']
        if source:
            texts[source] = included(f'docs/{source}', chapter['content'])
    pages = {f'docs/{source}': source for source in texts}
    pages.update({path: source for source, (path, _) in texts.items()})
    for chapter in every:
        source = chapter.get('source_path') or chapter['path']
        if not source:
            continue
        page, text = texts[source]
        new, end = [], 0
        for match in LINK.finditer(masked(text)):
            found = split(page, match.group(2))
            if found and match.group(2)[0] != '#':
                new += [text[end:match.start(2)], target(found, source, pages)]
                end = match.end(2)
        chapter['content'] = ''.join(new) + text[end:]
    json.dump(book, sys.stdout)


if __name__ == '__main__':
    main()
