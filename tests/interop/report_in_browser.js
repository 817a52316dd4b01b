// Opens pages in a real browser and says what it sees of them, as JSON.
// Arguments: the browser's program, a folder for pictures of the pages, then pages.
"use strict";
const { chromium } = require("playwright-core");
const path = require("path");
const { pathToFileURL } = require("url");

const VIEWS = [
  { width: 375, scheme: "light" },
  { width: 375, scheme: "dark" },
  { width: 1280, scheme: "light" },
  { width: 1280, scheme: "dark" },
];

// Runs on the page: what is too wide, what text has too little contrast, which pictures are not there.
function look() {
  const parse = (colour) => (colour.match(/[\d.]+/g) || []).map(Number);
  const luminance = ([r, g, b]) => {
    const [x, y, z] = [r, g, b].map((c) => (c / 255 <= 0.04045 ? c / 255 / 12.92 : ((c / 255 + 0.055) / 1.055) ** 2.4));
    return 0.2126 * x + 0.7152 * y + 0.0722 * z;
  };
  const ground = (element) => {
    for (let at = element; at; at = at.parentElement) {
      const colour = parse(getComputedStyle(at).backgroundColor);
      if (colour.length === 3 || colour[3] > 0.99) return colour;
    }
    return [255, 255, 255];
  };
  const faint = [];
  let texts = 0;
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let node = walker.nextNode(); node; node = walker.nextNode()) {
    const element = node.parentElement;
    if (!node.data.trim() || !element.checkVisibility() || element.closest("title, desc, style")) continue;
    texts += 1;
    const style = getComputedStyle(element);
    const colour = parse(style.color);
    const [light, dark] = [luminance(colour), luminance(ground(element))].sort((a, b) => b - a);
    const ratio = (light + 0.05) / (dark + 0.05);
    if (ratio < 4.5) faint.push(`${node.data.trim().slice(0, 40)}: ${ratio.toFixed(2)}`);
  }
  return {
    texts,
    faint,
    overflow: document.documentElement.scrollWidth - window.innerWidth,
    headings: [...document.querySelectorAll("h1, h2")].filter((h) => h.checkVisibility()).map((h) => h.textContent),
    unseen: [...document.images].filter((image) => !image.complete || image.naturalWidth === 0).length,
    images: document.images.length,
    plots: document.querySelectorAll("img.plot").length,
    background: getComputedStyle(document.body).backgroundColor,
  };
}

async function keyboard(page) {
  await page.keyboard.press("Tab");
  const first = await page.evaluate(() => document.activeElement.className);
  const reached = new Set();
  for (let k = 0; k < 400; k += 1) {
    await page.keyboard.press("Tab");
    const tag = await page.evaluate(() => document.activeElement.tagName);
    reached.add(tag);
    if (tag === "SUMMARY") break;
  }
  await page.keyboard.press("Enter");
  const opened = await page.evaluate(() => Boolean(document.activeElement.closest("details")?.open));
  return { first, reached: [...reached], opened };
}

async function visit(browser, file, folder) {
  const found = { messages: [], requests: [], dialogs: [], views: [] };
  for (const { width, scheme } of VIEWS) {
    const context = await browser.newContext({ viewport: { width, height: 800 }, colorScheme: scheme });
    const page = await context.newPage();
    page.on("console", (message) => found.messages.push(message.text()));
    page.on("pageerror", (error) => found.messages.push(String(error)));
    page.on("dialog", (dialog) => { found.dialogs.push(dialog.message()); dialog.dismiss(); });
    page.on("request", (request) => { if (!request.url().startsWith("data:")) found.requests.push(request.url()); });
    await page.goto(pathToFileURL(file).href);
    found.views.push({ width, scheme, ...(await page.evaluate(look)) });
    const picture = `${path.basename(file, ".html")}_${width}_${scheme}.png`;
    await page.screenshot({ path: path.join(folder, picture), fullPage: true });
    if (width === 1280 && scheme === "dark") {
      found.keyboard = await keyboard(page);
      const printed = await page.pdf({ format: "A4" });
      found.printed = printed.length;
      await page.emulateMedia({ media: "print" });
      await page.setViewportSize({ width: 720, height: 1000 });
      found.printedOverflow = await page.evaluate(() => document.documentElement.scrollWidth - window.innerWidth);
      found.printedBackground = await page.evaluate(() => getComputedStyle(document.body).backgroundColor);
    }
    await context.close();
  }
  return found;
}

(async () => {
  const [program, folder, ...files] = process.argv.slice(2);
  const browser = await chromium.launch({ executablePath: program, args: ["--no-sandbox"] });
  const found = {};
  for (const file of files) found[path.basename(file)] = await visit(browser, file, folder);
  await browser.close();
  process.stdout.write(JSON.stringify(found));
})();
