// Waits of C++, which its run time makes by `syscall`.
#include <chrono>
#include <cstdio>
#include <future>
#include <semaphore>
#include <thread>

using namespace std::chrono;
using namespace std::chrono_literals;

static steady_clock::time_point start = steady_clock::now();

static void print(const char *name, bool result) {
    std::printf("%s %d %.2f\n", name, result, duration<double>(steady_clock::now() - start).count());
    start = steady_clock::now();
}

int main() {
    std::promise<int> promise;
    auto future = promise.get_future();
    print("in vain", future.wait_for(300ms) == std::future_status::timeout);
    auto result = std::async(std::launch::async, [] { std::this_thread::sleep_for(200ms); return 5; });
    print("async", result.wait_for(1s) == std::future_status::ready);
    print("value", result.get() == 5);
    std::counting_semaphore<4> semaphore(0);
    print("semaphore in vain", !semaphore.try_acquire_for(300ms));
    std::thread thread([&] { std::this_thread::sleep_for(100ms); semaphore.release(); });
    print("semaphore", semaphore.try_acquire_for(1s));
    thread.join();
    std::atomic<int> flag{0};
    std::thread other([&] { std::this_thread::sleep_for(100ms); flag = 1; flag.notify_one(); });
    flag.wait(0);
    print("atomic", flag == 1);
    other.join();
}
