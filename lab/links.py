#!/usr/bin/env python3
"""links.py: checks the links of all Markdown pages of the repository.

    lab/links.py

Each relative link must lead to a file or folder, and each anchor to a heading. Each page of docs/ must be in
docs/SUMMARY.md, and the page that docs/questions.md names must contain each answer. Exit status: 0 all links are correct, 1 otherwise. Standard library only.
"""
import posixpath, re, subprocess, sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LINK = re.compile(r'(?<!\\)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^()\s]+)\)')
INCLUDE = re.compile(r'^\{\{#include (\S+)\}\}$', re.M)
FENCE = re.compile(r'^(```|~~~).*?^\1[^\n]*$', re.M | re.S)


def masked(text):
    """Returns the text with all code replaced by spaces, so that positions do not change."""
    blank = lambda match: re.sub(r'[^\n]', ' ', match.group(0))
    text = FENCE.sub(blank, text)
    text = re.sub(r'(?m)(?<=\n\n)(?: {4}[^\n]*\n)+', blank, text)
    return re.sub(r'(`+)(?!`).+?(?<!`)\1(?!`)', blank, text)


def included(page, text):
    """Returns the path and the text of the page that this page includes, or its own."""
    found = INCLUDE.search(text)
    if not found:
        return page, text
    other = posixpath.normpath(posixpath.join(posixpath.dirname(page), found.group(1)))
    return other, (ROOT / other).read_text(encoding='utf-8')


def anchors(text):
    """Returns the anchors of all headings, as GitHub and mdBook form them."""
    found = set()
    for heading in re.findall(r'(?m)^#+ (.*?)#*$', FENCE.sub('', text)):
        plain = LINK.sub(r'\1', heading).strip().lower()
        name = re.sub(r'\s', '-', re.sub(r'[^\w\s-]', '', plain))
        copies = sum(1 for a in found if a == name or re.fullmatch(re.escape(name) + r'-\d+', a))
        found.add(f'{name}-{copies}' if copies else name)
    return found


def split(page, target):
    """Returns path and anchor of a relative link, or None for a link to another site."""
    if re.match(r'[a-z+]+:', target):
        return None
    path, _, anchor = target.partition('#')
    return (posixpath.normpath(posixpath.join(posixpath.dirname(page), path)) if path else page), anchor


def main():
    listed = subprocess.run(['git', 'ls-files', '-co', '--exclude-standard', '*.md'], cwd=ROOT, check=True,
                            capture_output=True, text=True).stdout.split('\n')
    pages = {page: (ROOT / page).read_text(encoding='utf-8') for page in listed if page and (ROOT / page).exists()}
    wrong = []
    for page, text in pages.items():
        try:
            included(page, text)
        except FileNotFoundError as error:
            wrong.append(f'{page}: includes a page that does not exist: {error.filename}')
            continue
        for match in LINK.finditer(masked(text)):
            found = split(page, match.group(2))
            if found is None:
                continue
            path, anchor = found
            line = text.count('\n', 0, match.start()) + 1
            if not (ROOT / path).exists():
                wrong.append(f'{page}:{line}: {match.group(2)}: no file {path}')
            elif anchor and path.endswith('.md') and anchor not in anchors(included(path, pages[path])[1]):
                wrong.append(f'{page}:{line}: {match.group(2)}: no heading with the anchor #{anchor} in {path}')
    summary = 'docs/SUMMARY.md'
    in_book = {split(summary, match.group(2))[0] for match in LINK.finditer(pages[summary])}
    wrong += [f'{page}: not in {summary}' for page in pages
              if page.startswith('docs/') and page != summary and page not in in_book]
    questions = 'docs/questions.md'
    answers = re.findall(r'\]\(([^()\s]+)\)\n\s+> (.*)', pages[questions])
    count = len(re.findall(r'(?m)^\d+\. ', pages[questions]))
    if count != len(answers):
        wrong.append(f'{questions}: {count} questions, {len(answers)} with a link and a quoted answer')
    for target, answer in answers:
        path = split(questions, target)[0]
        if path in pages and answer not in ' '.join(included(path, pages[path])[1].split()):
            wrong.append(f'{questions}: {path} does not contain: {answer}')
    print('\n'.join(wrong) or f'{len(pages)} pages: all links are correct')
    return 1 if wrong else 0


if __name__ == '__main__':
    sys.exit(main())
