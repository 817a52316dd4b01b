// Opens the viewer's page in a real browser, draws it by software, and tells what came from where, as JSON.
// Arguments: the browser's program, the page's address, the file of the image, how many seconds to look at most.
// An image is taken every few seconds, until the one who started this writes a line to standard input.

const { chromium } = require("playwright-core");

const PAUSE_MS = 4000;
const SOFTWARE = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"];

async function main([program, address, image, seconds]) {
  const answered = new Set();
  const blocked = new Set();
  let satisfied = false;
  process.stdin.on("data", () => { satisfied = true; });
  const browser = await chromium.launch({ executablePath: program, args: SOFTWARE });
  const page = await browser.newPage({ viewport: { width: 1200, height: 800 } });
  page.on("response", (answer) => answered.add(new URL(answer.url()).hostname));
  page.on("requestfailed", (request) => blocked.add(new URL(request.url()).hostname));
  await page.goto(address);
  const stop = Date.now() + Number(seconds) * 1000;
  while (!satisfied && Date.now() < stop) {
    await page.waitForTimeout(PAUSE_MS);
    await page.screenshot({ path: image, timeout: 120000 });
    process.stdout.write("image\n");
  }
  await browser.close();
  process.stdout.write(`${JSON.stringify({ answered: [...answered], blocked: [...blocked] })}\n`);
  process.exit(0);
}

main(process.argv.slice(2));
